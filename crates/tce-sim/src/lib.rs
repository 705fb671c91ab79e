//! x
#[cfg(test)]
mod tests { #[test] fn v() { assert_eq!(mujoco_rs::mujoco_version(), "3.17.0"); } }
