//! The four robots of the benchmark, unshifted (the OpenAI Gym v2 locomotion models).

use tce_data::Agent;

use super::robot::{Body, Contact, Geom, Integrator, Joint, JointKind, Motor, Robot, Shape, Vec3};

const X: Vec3 = [1.0, 0.0, 0.0];
const Y: Vec3 = [0.0, 1.0, 0.0];
const Z: Vec3 = [0.0, 0.0, 1.0];
/// Hopper's and Walker2d's leg joints rotate about -y.
const MINUS_Y: Vec3 = [0.0, -1.0, 0.0];
/// Earth's gravity along z, m/s^2.
pub(super) const EARTH: f64 = -9.81;

/// Converts a range from degrees to radians.
pub(super) fn degrees(low: f64, high: f64) -> [f64; 2] {
    [low.to_radians(), high.to_radians()]
}

/// The robot description of `agent` in the source domain.
pub fn robot(agent: Agent) -> Robot {
    match agent {
        Agent::HalfCheetah => half_cheetah(),
        Agent::Hopper => hopper(),
        Agent::Walker2d => walker2d(),
        Agent::Ant => ant(),
    }
}

fn motors(joints: &[(&str, f64)]) -> Vec<Motor> {
    joints.iter().map(|&(joint, gear)| Motor { joint: joint.to_owned(), gear }).collect()
}

/// The three joints of a robot that moves in the x-z plane. With `height`, they are at the floor below the torso, so
/// the root's z coordinate is the height of the torso. Without it, z is relative to the start.
fn planar_root(torso: Body, height: f64) -> Body {
    let slide =
        |name, axis| Joint { position: [0.0, 0.0, -height], ..Joint::free_moving(name, JointKind::Slide, axis) };
    torso.joint(slide("rootx", X)).joint(Joint { reference: height, ..slide("rootz", Z) }).joint(Joint::free_moving(
        "rooty",
        JointKind::Hinge,
        Y,
    ))
}

fn half_cheetah() -> Robot {
    const RADIUS: f64 = 0.046;
    let limb = |name: &str, position, range, (damping, stiffness), geom| {
        let joint = Joint { stiffness, ..Joint::hinge(name, Y, range, 0.1, damping) };
        Body::new(name, position, geom).joint(joint)
    };
    let capsule = |name: &str, half_length, centre, tilt| Geom::tilted(name, RADIUS, half_length, centre, tilt);

    let bfoot = capsule("bfoot", 0.094, [0.03, 0.0, -0.097], -0.27);
    let bfoot = limb("bfoot", [-0.28, 0.0, -0.14], [-0.4, 0.785], (3.0, 120.0), bfoot);
    let bshin = capsule("bshin", 0.15, [-0.14, 0.0, -0.07], -2.03);
    let bshin = limb("bshin", [0.16, 0.0, -0.25], [-0.785, 0.785], (4.5, 180.0), bshin).child(bfoot);
    let bthigh = capsule("bthigh", 0.145, [0.1, 0.0, -0.13], -3.8);
    let bthigh = limb("bthigh", [-0.5, 0.0, 0.0], [-0.52, 1.05], (6.0, 240.0), bthigh).child(bshin);

    let ffoot = capsule("ffoot", 0.07, [0.045, 0.0, -0.07], -0.6);
    let ffoot = limb("ffoot", [0.13, 0.0, -0.18], [-0.5, 0.5], (1.5, 60.0), ffoot);
    let fshin = capsule("fshin", 0.106, [0.065, 0.0, -0.09], -0.6);
    let fshin = limb("fshin", [-0.14, 0.0, -0.24], [-1.2, 0.87], (3.0, 120.0), fshin).child(ffoot);
    let fthigh = capsule("fthigh", 0.133, [-0.07, 0.0, -0.12], 0.52);
    let fthigh = limb("fthigh", [0.5, 0.0, 0.0], [-1.0, 0.7], (4.5, 180.0), fthigh).child(fshin);

    let mut torso =
        Body::new("torso", [0.0, 0.0, 0.7], Geom::segment("torso", RADIUS, [-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]));
    torso.geoms.push(capsule("head", 0.15, [0.6, 0.0, 0.1], 0.87));
    Robot {
        name: "halfcheetah".to_owned(),
        integrator: Integrator::Euler,
        timestep: 0.01,
        gravity: EARTH,
        density: 1000.0,
        total_mass: Some(14.0),
        contact: Contact {
            between_bodies: false,
            condim: 3,
            margin: 0.0,
            friction: [0.4, 0.1, 0.1],
            solver: Some(([0.0, 0.8, 0.01], [0.02, 1.0])),
        },
        limit_solver: Some(([0.0, 0.8, 0.03], [0.02, 1.0])),
        torso: planar_root(torso, 0.0).child(bthigh).child(fthigh),
        motors: motors(&[
            ("bthigh", 120.0),
            ("bshin", 90.0),
            ("bfoot", 60.0),
            ("fthigh", 120.0),
            ("fshin", 60.0),
            ("ffoot", 30.0),
        ]),
    }
}

/// A limb of Hopper or Walker2d: a body at `position` with a joint about -y.
fn leg_part(position: Vec3, range: [f64; 2], (armature, damping): (f64, f64), geom: Geom) -> Body {
    let name = geom.name.clone();
    Body::new(&name, position, geom).joint(Joint::hinge(&name, MINUS_Y, range, armature, damping))
}

/// The upright torso of Hopper and Walker2d.
fn upright_torso() -> Body {
    let geom = Geom::segment("torso", 0.05, [0.0, 0.0, 0.2], [0.0, 0.0, -0.2]).friction(0.9);
    planar_root(Body::new("torso", [0.0, 0.0, 1.25], geom), 1.25)
}

fn hopper() -> Robot {
    let dynamics = (1.0, 1.0);
    let foot = Geom::segment("foot", 0.06, [-0.13, 0.0, 0.0], [0.26, 0.0, 0.0]).friction(2.0);
    let foot = leg_part([0.0, 0.0, -0.5], degrees(-45.0, 45.0), dynamics, foot);
    let leg = Geom::segment("leg", 0.04, [0.0; 3], [0.0, 0.0, -0.5]).friction(0.9);
    let leg = leg_part([0.0, 0.0, -0.45], degrees(-150.0, 0.0), dynamics, leg).child(foot);
    let thigh = Geom::segment("thigh", 0.05, [0.0; 3], [0.0, 0.0, -0.45]).friction(0.9);
    let thigh = leg_part([0.0, 0.0, -0.2], degrees(-150.0, 0.0), dynamics, thigh).child(leg);
    Robot {
        name: "hopper".to_owned(),
        integrator: Integrator::Rk4,
        timestep: 0.002,
        gravity: EARTH,
        density: 1000.0,
        total_mass: None,
        contact: Contact {
            between_bodies: true,
            condim: 1,
            margin: 0.001,
            friction: [1.0, 0.005, 0.0001],
            solver: Some(([0.8, 0.8, 0.01], [0.02, 1.0])),
        },
        limit_solver: None,
        torso: upright_torso().child(thigh),
        motors: motors(&[("thigh", 200.0), ("leg", 200.0), ("foot", 200.0)]),
    }
}

fn walker2d() -> Robot {
    let limb = |suffix: &str, foot_friction| {
        let named = |part: &str| format!("{part}{suffix}");
        let dynamics = (0.01, 0.1);
        let foot = Geom::segment(&named("foot"), 0.06, [0.0; 3], [0.2, 0.0, 0.0]).friction(foot_friction);
        let foot = leg_part([0.0, 0.0, -0.5], degrees(-45.0, 45.0), dynamics, foot);
        let leg = Geom::segment(&named("leg"), 0.04, [0.0; 3], [0.0, 0.0, -0.5]).friction(0.9);
        let leg = leg_part([0.0, 0.0, -0.45], degrees(-150.0, 0.0), dynamics, leg).child(foot);
        let thigh = Geom::segment(&named("thigh"), 0.05, [0.0; 3], [0.0, 0.0, -0.45]).friction(0.9);
        leg_part([0.0, 0.0, -0.2], degrees(-150.0, 0.0), dynamics, thigh).child(leg)
    };
    Robot {
        name: "walker2d".to_owned(),
        integrator: Integrator::Rk4,
        timestep: 0.002,
        gravity: EARTH,
        density: 1000.0,
        total_mass: None,
        contact: Contact { between_bodies: false, condim: 3, margin: 0.0, friction: [0.7, 0.1, 0.1], solver: None },
        limit_solver: None,
        torso: upright_torso().child(limb("", 0.9)).child(limb("_left", 1.9)),
        motors: motors(&["thigh", "leg", "foot", "thigh_left", "leg_left", "foot_left"].map(|joint| (joint, 100.0))),
    }
}

fn ant() -> Robot {
    const RADIUS: f64 = 0.08;
    // Legs 1 and 2 are the front ones. The signs give the quadrant of the x-y plane in which a leg lies. The knees of
    // opposite legs rotate about parallel axes, so two of them bend towards negative angles.
    let leg = |number: usize, sx: f64, sy: f64, knee_sign: f64| {
        let knee_range = if knee_sign > 0.0 { degrees(30.0, 70.0) } else { degrees(-70.0, -30.0) };
        let hip_end = [0.2 * sx, 0.2 * sy, 0.0];
        let capsule = |name: String, end| Geom::segment(&name, RADIUS, [0.0; 3], end);
        let ankle_name = format!("ankle_{number}");
        let ankle = capsule(format!("ankle_{number}_geom"), [0.4 * sx, 0.4 * sy, 0.0]);
        let ankle = Body::new(&ankle_name, hip_end, ankle).joint(Joint::hinge(
            &ankle_name,
            [-sx * sy, 1.0, 0.0],
            knee_range,
            1.0,
            1.0,
        ));
        let hip_name = format!("hip_{number}");
        let hip = Body::new(&hip_name, hip_end, capsule(format!("leg_{number}_geom"), hip_end))
            .joint(Joint::hinge(&hip_name, Z, degrees(-30.0, 30.0), 1.0, 1.0))
            .child(ankle);
        Body::new(&format!("aux_{number}"), [0.0; 3], capsule(format!("aux_{number}_geom"), hip_end)).child(hip)
    };
    let torso = Geom { name: "torso".to_owned(), radius: 0.25, shape: Shape::Sphere, sliding_friction: None };
    Robot {
        name: "ant".to_owned(),
        integrator: Integrator::Rk4,
        timestep: 0.01,
        gravity: EARTH,
        density: 5.0,
        total_mass: None,
        contact: Contact { between_bodies: false, condim: 3, margin: 0.01, friction: [1.0, 0.5, 0.5], solver: None },
        limit_solver: None,
        torso: Body::new("torso", [0.0, 0.0, 0.75], torso)
            .joint(Joint::free_moving("root", JointKind::Free, Z))
            .child(leg(1, 1.0, 1.0, 1.0))
            .child(leg(2, -1.0, 1.0, -1.0))
            .child(leg(3, -1.0, -1.0, -1.0))
            .child(leg(4, 1.0, -1.0, 1.0)),
        motors: motors(
            &["hip_4", "ankle_4", "hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3"]
                .map(|joint| (joint, 150.0)),
        ),
    }
}
