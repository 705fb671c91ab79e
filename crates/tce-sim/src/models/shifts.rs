//! The dynamics shifts of the benchmark, as edits of a robot's description.
//!
//! Where the paper's text and the public data disagree, this code follows the data: every alternative was tested
//! against them, and its errors were larger by orders of magnitude (`shared/reference/environments.md`).

use tce_data::{Agent, Shift};

use super::agents::{EARTH, degrees};
use super::robot::{Geom, Robot, Shape, Vec3};

/// Changes the unshifted robot of `agent` into the robot of the target domain.
pub fn apply(agent: Agent, shift: Shift, robot: &mut Robot) {
    match shift {
        Shift::Source => {}
        Shift::Morph => morph(agent, robot),
        Shift::Kinematic => kinematic(agent, robot),
        Shift::Gravity => robot.gravity = 0.5 * EARTH,
        Shift::Gravity5 => robot.gravity = 5.0 * EARTH,
    }
}

/// Makes the capsule of `body` run from the body's origin to `end`, and attaches `next` at `end`.
fn reshape(robot: &mut Robot, body: &str, end: Vec3, next: Option<&str>) {
    robot.geom_mut(body).shape = Shape::Segment { from: [0.0; 3], to: end };
    if let Some(next) = next {
        robot.body_mut(next).position = end;
    }
}

fn morph(agent: Agent, robot: &mut Robot) {
    match agent {
        // Thighs of almost no length; the shins are straight capsules between the joints.
        Agent::HalfCheetah => {
            reshape(robot, "bthigh", [-0.0001, 0.0, -0.0001], Some("bshin"));
            reshape(robot, "bshin", [-0.13, 0.0, -0.15], Some("bfoot"));
            reshape(robot, "fthigh", [0.0001, 0.0, 0.0001], Some("fshin"));
            reshape(robot, "fshin", [0.01, 0.0, -0.16], Some("ffoot"));
            // The hind foot keeps its position but is as short as the front one.
            let foot = robot.geom_mut("bfoot");
            *foot = Geom::tilted("bfoot", foot.radius, 0.07, [0.03, 0.0, -0.097], -0.27);
        }
        // A larger torso and a thinner thigh.
        Agent::Hopper => {
            robot.geom_mut("torso").radius = 0.125;
            robot.geom_mut("thigh").radius = 0.04;
        }
        // The right thigh has almost no length. The right leg is longer by half of the thigh's length.
        Agent::Walker2d => {
            reshape(robot, "thigh", [0.0, 0.0, -0.005], Some("leg"));
            reshape(robot, "leg", [0.0, 0.0, -0.745], Some("foot"));
        }
        // Short front shins.
        Agent::Ant => {
            reshape(robot, "ankle_1", [0.1, 0.1, 0.0], None);
            reshape(robot, "ankle_2", [-0.1, 0.1, 0.0], None);
        }
    }
}

fn kinematic(agent: Agent, robot: &mut Robot) {
    match agent {
        Agent::HalfCheetah => *robot.range_mut("bthigh") = Some([-0.0052, 0.0105]),
        Agent::Hopper => {
            *robot.range_mut("thigh") = Some(degrees(-0.15, 0.0));
            *robot.range_mut("foot") = Some(degrees(-18.0, 18.0));
        }
        // Only the right foot.
        Agent::Walker2d => *robot.range_mut("foot") = Some(degrees(-0.45, 0.45)),
        Agent::Ant => {
            *robot.range_mut("hip_1") = Some(degrees(-0.3, 0.3));
            *robot.range_mut("hip_2") = Some(degrees(-0.3, 0.3));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::agents::robot;

    #[test]
    fn gravity_is_scaled_and_nothing_else() {
        for agent in Agent::ALL {
            for (shift, gravity) in [(Shift::Gravity, -4.905), (Shift::Gravity5, -49.05)] {
                let mut shifted = robot(agent);
                apply(agent, shift, &mut shifted);
                assert!((shifted.gravity - gravity).abs() < 1e-12);
                shifted.gravity = EARTH;
                assert_eq!(shifted, robot(agent));
            }
        }
    }

    #[test]
    fn walkers_right_leg_is_shortened_and_its_left_leg_is_not() {
        let mut shifted = robot(Agent::Walker2d);
        apply(Agent::Walker2d, Shift::Morph, &mut shifted);
        assert_eq!(shifted.body_mut("leg").position, [0.0, 0.0, -0.005]);
        assert_eq!(shifted.body_mut("foot").position, [0.0, 0.0, -0.745]);
        assert_eq!(shifted.body_mut("foot_left").position, [0.0, 0.0, -0.5]);
    }
}
