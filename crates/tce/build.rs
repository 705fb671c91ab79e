//! Lets the binary and the tests of this package find libmujoco, which `tce-sim` fetched.

fn main() {
    let directory = std::env::var("DEP_TCE_MUJOCO_LIB_DIR").expect("tce-sim's build script sets it");
    println!("cargo::rustc-link-arg=-Wl,-rpath,{directory}");
}
