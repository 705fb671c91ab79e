//! The robot as shapes to draw: capsules with one paint each.

use std::sync::Arc;

use mujoco_rs::prelude::{MjData, MjModel, MjtObjBase};
use mujoco_rs::wrappers::mj_model::MjtGeomBase;
use tce_data::{Agent, Shift};

use crate::SimError;
use crate::models::robot::Vec3;
use crate::models::{compiled, difference};

/// The kind of a part, which determines its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Paint {
    /// The trunk.
    Torso,
    /// Right limbs; HalfCheetah's hind leg.
    Right,
    /// Left limbs; HalfCheetah's fore leg.
    Left,
    /// Parts that the shift changed.
    Changed,
}

/// A capsule: all points within `radius` of the segment between the ends. A sphere has equal ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Solid {
    pub ends: [Vec3; 2],
    pub radius: f64,
    pub paint: Paint,
}

/// The parts of one robot, which can be put into any pose.
pub(super) struct Body {
    data: MjData<Arc<MjModel>>,
    torso: usize,
    geoms: Vec<Part>,
}

struct Part {
    geom: usize,
    sphere: bool,
    radius: f64,
    half_length: f64,
    paint: Paint,
    /// Offset in y. See [`aside`].
    aside: f64,
}

impl Body {
    pub fn new(agent: Agent, shift: Shift) -> Result<Self, SimError> {
        let model = compiled(agent, shift)?;
        let changed = difference(agent, shift).geoms;
        let torso = model.name_to_id(MjtObjBase::mjOBJ_BODY, "torso").expect("every robot has a torso");
        let mut geoms = Vec::new();
        for (geom, (kind, size)) in model.geom_type().iter().zip(model.geom_size()).enumerate() {
            let sphere = *kind == MjtGeomBase::mjGEOM_SPHERE;
            if !sphere && *kind != MjtGeomBase::mjGEOM_CAPSULE {
                continue; // the floor
            }
            let name = model.id_to_name(MjtObjBase::mjOBJ_GEOM, geom).expect("every geom has a name");
            let own = paint(agent, name);
            let paint = if changed.contains(name) { Paint::Changed } else { own };
            geoms.push(Part { geom, sphere, radius: size[0], half_length: size[1], paint, aside: aside(agent, own) });
        }
        Ok(Self { data: MjData::new(model), torso, geoms })
    }

    /// Positions of the torso and all parts at these coordinates.
    pub fn pose(&mut self, qpos: &[f64]) -> (Vec3, Vec<Solid>) {
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.kinematics();
        let (centres, frames) = (self.data.geom_xpos(), self.data.geom_xmat());
        let solids = self.geoms.iter().map(|part| {
            let (mut centre, frame) = (centres[part.geom], frames[part.geom]);
            centre[1] += part.aside;
            // The axis of a capsule is its z axis.
            let reach = if part.sphere { 0.0 } else { part.half_length };
            let end = |side: f64| std::array::from_fn(|i| centre[i] + side * reach * frame[3 * i + 2]);
            Solid { ends: [end(-1.0), end(1.0)], radius: part.radius, paint: part.paint }
        });
        (self.data.xpos()[self.torso], solids.collect())
    }
}

/// The paint of an unchanged part, determined by the name of its geom (see `models/agents.rs`).
fn paint(agent: Agent, name: &str) -> Paint {
    if name == "torso" || name == "head" {
        return Paint::Torso;
    }
    let left = match agent {
        Agent::Hopper => false,
        Agent::Walker2d => name.ends_with("_left"),
        Agent::HalfCheetah => name.starts_with('f'),
        // Legs 1 and 2 are at positive y.
        Agent::Ant => name.contains("_1_") || name.contains("_2_"),
    };
    if left { Paint::Left } else { Paint::Right }
}

/// Sideways offset at which a part is drawn. Walker2d's legs move through each other in one plane; side by side they
/// can be distinguished. The offset is less than a thigh's width, so the feet stay near their true positions.
fn aside(agent: Agent, paint: Paint) -> f64 {
    match (agent, paint) {
        (Agent::Walker2d, Paint::Right) => -0.06,
        (Agent::Walker2d, Paint::Left) => 0.06,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rest(agent: Agent, shift: Shift) -> (Vec3, Vec<Solid>) {
        let qpos = compiled(agent, shift).unwrap().qpos0().to_vec();
        Body::new(agent, shift).unwrap().pose(&qpos)
    }

    /// Hopper at rest, from its description: torso at about 1.25 m, thigh from 1.05 m to 0.6 m, foot at 0.1 m.
    #[test]
    fn parts_are_where_the_model_says() {
        let (torso, solids) = rest(Agent::Hopper, Shift::Source);
        assert_eq!(torso, [0.0, 0.0, 1.25]);
        let close = |a: Vec3, b: Vec3| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9);
        let lies = |s: &Solid, a, b| {
            (close(s.ends[0], a) && close(s.ends[1], b)) || (close(s.ends[0], b) && close(s.ends[1], a))
        };
        assert!(lies(&solids[1], [0.0, 0.0, 1.05], [0.0, 0.0, 0.6]), "{:?}", solids[1]);
        assert!(lies(&solids[3], [-0.13, 0.0, 0.1], [0.26, 0.0, 0.1]), "{:?}", solids[3]);
        assert_eq!(solids.iter().map(|s| s.radius).collect::<Vec<_>>(), [0.05, 0.05, 0.04, 0.06]);
        let (_, ant) = rest(Agent::Ant, Shift::Source);
        assert_eq!((ant.len(), ant[0].ends[0], ant[0].radius), (13, ant[0].ends[1], 0.25));
    }

    /// In every shift, all changed parts have the accent colour, and no other part has it.
    #[test]
    fn the_accent_marks_what_differs_and_nothing_else() {
        for agent in Agent::ALL {
            for shift in Shift::ALL {
                let (_, source) = rest(agent, Shift::Source);
                let (_, target) = rest(agent, shift);
                let model = compiled(agent, shift).unwrap();
                let changed = difference(agent, shift).geoms;
                assert_eq!(source.len(), target.len());
                for (k, (old, new)) in source.iter().zip(&target).enumerate() {
                    // The floor is geom 0.
                    let name = model.id_to_name(MjtObjBase::mjOBJ_GEOM, k + 1).unwrap();
                    let marked = new.paint == Paint::Changed;
                    assert_eq!(marked, changed.contains(name), "{agent}-{shift}: {name}");
                    assert!(marked || (new.paint == old.paint && new.radius == old.radius), "{agent}-{shift}: {name}");
                }
            }
        }
    }

    #[test]
    fn only_walkers_legs_are_drawn_aside() {
        for agent in [Agent::Hopper, Agent::HalfCheetah, Agent::Walker2d] {
            for solid in rest(agent, Shift::Source).1 {
                let expected = match (agent, solid.paint) {
                    (Agent::Walker2d, Paint::Right) => -0.06,
                    (Agent::Walker2d, Paint::Left) => 0.06,
                    _ => 0.0,
                };
                assert!((solid.ends[0][1] - expected).abs() < 1e-12, "{agent}: {solid:?}");
            }
        }
    }
}
