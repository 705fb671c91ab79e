//! Tests of the generated models: MuJoCo's numbers for them, and their agreement with the reference models.

use std::path::PathBuf;

use mujoco_rs::prelude::MjModel;
use tce_data::{Agent, Shift};
use tce_sim::models::{compiled, mjcf};

fn all() -> impl Iterator<Item = (Agent, Shift)> {
    Agent::ALL.into_iter().flat_map(|agent| Shift::ALL.into_iter().map(move |shift| (agent, shift)))
}

#[test]
fn every_model_compiles_to_its_dimensions() {
    for (agent, shift) in all() {
        let model = compiled(agent, shift).unwrap();
        let (nq, nv) = match agent {
            Agent::HalfCheetah | Agent::Walker2d => (9, 9),
            Agent::Hopper => (6, 6),
            Agent::Ant => (15, 14),
        };
        assert_eq!((model.nq(), model.nv(), model.nu()), (nq, nv, agent.dims().1 as i64), "{agent}-{shift}");
    }
}

#[test]
fn half_cheetah_weighs_fourteen_kilograms_in_every_domain() {
    for shift in Shift::ALL {
        let mass = compiled(Agent::HalfCheetah, shift).unwrap().totalmass();
        assert!((mass - 14.0).abs() < 1e-9, "{shift}: {mass} kg");
    }
}

#[test]
fn hoppers_mass_is_that_of_four_cylinders() {
    // Computed by hand: 1000 pi (r^2 h) with h = L + r: torso .05/.45, thigh .05/.5, leg .04/.54, foot .06/.45.
    let expected = 1000.0 * std::f64::consts::PI * (0.0025 * 0.45 + 0.0025 * 0.5 + 0.0016 * 0.54 + 0.0036 * 0.45);
    let mass = compiled(Agent::Hopper, Shift::Source).unwrap().totalmass();
    assert!((mass - expected).abs() < 1e-9, "{mass} kg instead of {expected} kg");
}

#[test]
fn contacts_begin_at_the_distance_of_old() {
    // This MuJoCo version adds the margins of the two geoms; the environments were written for the larger of the two.
    for (agent, distance) in
        [(Agent::HalfCheetah, 0.0), (Agent::Hopper, 0.001), (Agent::Walker2d, 0.0), (Agent::Ant, 0.01)]
    {
        let model = compiled(agent, Shift::Source).unwrap();
        let margins = model.geom_margin();
        assert!(margins[1..].iter().all(|m| margins[0] + m == distance), "{agent}: {margins:?}");
    }
}

/// The full inertia tensor of body `b` about its centre of mass, in the body's frame. (Principal axes are ambiguous
/// where two moments are equal; the tensor is not.)
fn inertia(model: &MjModel, b: usize) -> [f64; 9] {
    let [w, x, y, z] = model.body_iquat()[b];
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let d = model.body_inertia()[b];
    std::array::from_fn(|k| (0..3).map(|m| r[k / 3][m] * d[m] * r[k % 3][m]).sum())
}

fn compare<'a>(what: &str, found: impl IntoIterator<Item = &'a f64>, expected: impl IntoIterator<Item = &'a f64>) {
    let (found, expected): (Vec<f64>, Vec<f64>) =
        (found.into_iter().copied().collect(), expected.into_iter().copied().collect());
    assert_eq!(found.len(), expected.len(), "{what}: number of entries");
    for (i, (f, e)) in found.iter().zip(&expected).enumerate() {
        assert!((f - e).abs() <= 1e-12 * e.abs().max(1e-3), "{what}, entry {i}: found {f}, expected {e}");
    }
}

#[test]
fn models_agree_with_the_reference_models() {
    let shared = std::env::var_os("TCE_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared"), PathBuf::from);
    let directory = shared.join("reference/models");
    if !directory.is_dir() {
        eprintln!("SKIPPED: models_agree_with_the_reference_models needs TCE_SHARED (reference/models)");
        return;
    }
    for (agent, shift) in all() {
        let ours = compiled(agent, shift).unwrap();
        let name = format!("{agent}_{}", shift.file_name());
        let theirs = MjModel::from_xml(directory.join(format!("{name}.xml"))).unwrap();
        macro_rules! same {
            ($($field:ident),*) => {$(
                assert_eq!(ours.$field(), theirs.$field(), "{name}: {}", stringify!($field));
            )*};
        }
        macro_rules! close {
            ($($field:ident),*) => {$(
                compare(
                    &format!("{name}: {}", stringify!($field)),
                    ours.$field().iter().flatten_numbers(),
                    theirs.$field().iter().flatten_numbers(),
                );
            )*};
        }
        same!(jnt_type, jnt_bodyid, jnt_limited, body_parentid, geom_type, geom_bodyid, geom_condim);
        same!(geom_contype, geom_conaffinity, actuator_trnid, actuator_ctrllimited);
        close!(body_mass, body_pos, body_quat, body_ipos, qpos0, qpos_spring);
        close!(jnt_range, jnt_axis, jnt_pos, jnt_solref, jnt_solimp, dof_armature);
        close!(geom_pos, geom_friction, geom_margin, geom_gap, geom_solref, geom_solimp);
        close!(actuator_gear, actuator_ctrlrange, actuator_gainprm, actuator_biasprm);
        // The floor's size only affects its appearance.
        compare(
            &format!("{name}: geom_size"),
            ours.geom_size()[1..].iter().flatten(),
            theirs.geom_size()[1..].iter().flatten(),
        );
        compare(
            &format!("{name}: geom_quat"),
            ours.geom_quat()[1..].iter().flatten(),
            theirs.geom_quat()[1..].iter().flatten(),
        );
        for b in 0..ours.nbody() as usize {
            compare(&format!("{name}: inertia of body {b}"), &inertia(&ours, b), &inertia(&theirs, b));
        }
        let (o, t) = (ours.opt(), theirs.opt());
        compare(&format!("{name}: gravity"), &o.gravity, &t.gravity);
        assert_eq!(
            (o.timestep, o.integrator, o.solver, o.cone),
            (t.timestep, t.integrator, t.solver, t.cone),
            "{name}"
        );
        assert_eq!((o.iterations, o.tolerance, o.impratio), (t.iterations, t.tolerance, t.impratio), "{name}");
    }
}

/// Numbers of a flat array or of an array of small vectors.
trait FlattenNumbers<'a> {
    fn flatten_numbers(self) -> Vec<&'a f64>;
}

impl<'a> FlattenNumbers<'a> for std::slice::Iter<'a, f64> {
    fn flatten_numbers(self) -> Vec<&'a f64> {
        self.collect()
    }
}

impl<'a, const N: usize> FlattenNumbers<'a> for std::slice::Iter<'a, [f64; N]> {
    fn flatten_numbers(self) -> Vec<&'a f64> {
        self.flatten().collect()
    }
}

#[test]
fn shifted_models_differ_from_the_source() {
    for agent in Agent::ALL {
        let texts: Vec<String> = Shift::ALL.iter().map(|&shift| mjcf(agent, shift)).collect();
        for i in 0..texts.len() {
            for j in 0..i {
                let body = |text: &str| text.lines().skip(1).collect::<Vec<_>>().join("\n");
                assert_ne!(body(&texts[i]), body(&texts[j]), "{agent}: {} and {}", Shift::ALL[i], Shift::ALL[j]);
            }
        }
    }
}
