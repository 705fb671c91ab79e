//! Tests of policies of other programs: against formulas in f64, and with all files of the shared collection.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use tce_base::{Rng, Streams, random::fill_normal};
use tce_learn::{Head, Policy, PolicyKind};
use zip::ZipWriter;
use zip::write::FileOptions;

/// One array of a file: name, shape, row-major values.
type Array = (&'static str, Vec<u64>, Vec<f64>);

/// The order in which numpy stores a matrix.
#[derive(Clone, Copy, PartialEq)]
enum Order {
    C,
    Fortran,
}

/// An array in the format of numpy's `save`.
fn npy(descr: &str, order: Order, shape: &[u64], body: impl Iterator<Item = u8>) -> Vec<u8> {
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let fortran = if order == Order::Fortran { "True" } else { "False" };
    let header = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': ({shape}), }}");
    let header = format!("{header:<117}\n");
    let size = (header.len() as u16).to_le_bytes();
    [b"\x93NUMPY\x01\x00".as_slice(), &size, header.as_bytes()].concat().into_iter().chain(body).collect()
}

/// An archive in the format of numpy's `savez_compressed`.
fn write(path: &Path, texts: &[(&str, &str)], arrays: &[Array], order: Order) {
    let mut npz = ZipWriter::new(File::create(path).unwrap());
    let mut add = |name: &str, bytes: Vec<u8>| {
        npz.start_file(format!("{name}.npy"), FileOptions::default()).unwrap();
        npz.write_all(&bytes).unwrap();
    };
    for (name, text) in texts {
        let letters = text.chars().flat_map(|c| (c as u32).to_le_bytes());
        add(name, npy(&format!("<U{}", text.len()), Order::C, &[], letters));
    }
    for (name, shape, values) in arrays {
        let at = |k: usize| match (order, shape.as_slice()) {
            (Order::Fortran, &[rows, columns]) => values[k % rows as usize * columns as usize + k / rows as usize],
            _ => values[k],
        };
        add(name, npy("<f8", order, shape, (0..values.len()).flat_map(|k| at(k).to_le_bytes())));
    }
    npz.finish().unwrap();
}

fn numbers(name: &'static str, shape: &[u64], scale: f64) -> Array {
    let mut values = vec![0.0; shape.iter().product::<u64>() as usize];
    fill_normal(&mut Streams::new(3).stream(name), &mut values);
    (name, shape.to_vec(), values.into_iter().map(|v| v as f64 * scale).collect())
}

fn positive((name, shape, values): Array) -> Array {
    (name, shape, values.into_iter().map(|v| v.abs() + 0.1).collect())
}

/// W x + b with W `[out, in]`.
fn affine(w: &[f64], b: Option<&[f64]>, x: &[f64]) -> Vec<f64> {
    let row = |(k, w): (usize, &[f64])| w.iter().zip(x).map(|(w, x)| w * x).sum::<f64>() + b.map_or(0.0, |b| b[k]);
    w.chunks(x.len()).enumerate().map(row).collect()
}

/// 4 observations, 2 actions, 5 and 3 hidden units.
fn weights() -> Vec<Array> {
    vec![
        numbers("w0", &[5, 4], 0.5),
        numbers("b0", &[5], 0.5),
        numbers("w1", &[3, 5], 0.5),
        numbers("b1", &[3], 0.5),
        numbers("wm", &[2, 3], 0.5),
        numbers("bm", &[2], 0.2),
    ]
}

const OBSERVATION: [f32; 4] = [0.3, -1.2, 2.0, 0.7];

fn noise() -> (Rng, [f32; 2]) {
    let rng = Streams::new(1).stream("act");
    let mut n = [0.0; 2];
    fill_normal(&mut rng.clone(), &mut n);
    (rng, n)
}

fn actions(path: &Path) -> ([f32; 2], [f32; 2]) {
    let policy = Policy::load(path).unwrap();
    let (mut mean, mut sampled) = ([0.0; 2], [0.0; 2]);
    policy.act(&OBSERVATION, None, &mut mean);
    policy.act(&OBSERVATION, Some(&mut [noise().0]), &mut sampled);
    (mean, sampled)
}

fn close(a: [f32; 2], b: &[f64]) {
    assert!(a.iter().zip(b).all(|(a, b)| (*a as f64 - b).abs() < 1e-5), "{a:?} is not {b:?}");
}

#[test]
fn gaussian_kinds_follow_their_formulas() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("policy.npz");
    let mean = numbers("obs_mean", &[4], 0.5);
    let spreads = [positive(numbers("obs_var", &[4], 1.0)), positive(numbers("obs_std", &[4], 1.0))];
    for (kind, act, spread) in [
        ("gaussian_clip", "relu", &spreads[0]),
        ("gaussian_clip", "tanh", &spreads[0]),
        ("gaussian_std_plus_1e-6", "tanh", &spreads[1]),
    ] {
        for order in [Order::C, Order::Fortran] {
            let mut arrays = weights();
            arrays.extend([numbers("log_std", &[2], 0.5), mean.clone(), spread.clone()]);
            arrays.extend([("eps", vec![], vec![1e-8]), ("clip", vec![], vec![1.1])]);
            write(&path, &[("kind", kind), ("act", act)], &arrays, order);
            let get = |name: &str| &arrays.iter().find(|a| a.0 == name).unwrap().2;
            let input = |d: usize| {
                let x = OBSERVATION[d] as f64 - mean.2[d];
                match kind {
                    "gaussian_clip" => (x / (spread.2[d] + 1e-8).sqrt()).clamp(-1.1, 1.1),
                    _ => x / (spread.2[d] + 1e-6),
                }
            };
            let hidden = |x: Vec<f64>| -> Vec<f64> {
                x.into_iter().map(|x| if act == "relu" { x.max(0.0) } else { x.tanh() }).collect()
            };
            let x: Vec<f64> = (0..4).map(input).collect();
            let h = hidden(affine(get("w0"), Some(get("b0")), &x));
            let h = hidden(affine(get("w1"), Some(get("b1")), &h));
            let z = affine(get("wm"), Some(get("bm")), &h);
            let (mean, sampled) = actions(&path);
            close(mean, &[0, 1].map(|d| z[d].clamp(-1.0, 1.0)));
            let n = noise().1;
            close(sampled, &[0, 1].map(|d| (z[d] + get("log_std")[d].exp() * n[d] as f64).clamp(-1.0, 1.0)));
        }
    }
}

#[test]
fn sac_and_linear_kinds_follow_their_formulas() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("policy.npz");
    let mut arrays = weights();
    // One ln σ above 2, which the formula clips to 2, and one within the range.
    arrays.extend([numbers("ws", &[2, 3], 0.1), ("bs", vec![2], vec![9.0, -0.5])]);
    write(&path, &[("kind", "sac_tanh_gaussian"), ("act", "relu")], &arrays, Order::C);
    let get = |name: &str| arrays.iter().find(|a| a.0 == name).unwrap().2.clone();
    let relu = |x: Vec<f64>| -> Vec<f64> { x.into_iter().map(|x| x.max(0.0)).collect() };
    let x = OBSERVATION.map(f64::from);
    let h = relu(affine(&get("w1"), Some(&get("b1")), &relu(affine(&get("w0"), Some(&get("b0")), &x))));
    let (mu, log_std) = (affine(&get("wm"), Some(&get("bm")), &h), affine(&get("ws"), Some(&get("bs")), &h));
    let (mean, sampled) = actions(&path);
    close(mean, &[mu[0].tanh(), mu[1].tanh()]);
    let n = noise().1;
    close(sampled, &[0, 1].map(|d| (mu[d] + log_std[d].clamp(-20.0, 2.0).exp() * n[d] as f64).tanh()));

    let wm = numbers("wm", &[2, 4], 0.3);
    let (mean, var) = (numbers("obs_mean", &[4], 0.5), positive(numbers("obs_var", &[4], 1.0)));
    let scalars = [("eps", vec![], vec![1e-8]), ("clip", vec![], vec![10.0])];
    let arrays: Vec<Array> = [wm.clone(), mean.clone(), var.clone()].into_iter().chain(scalars).collect();
    write(&path, &[("kind", "linear_clip")], &arrays, Order::C);
    let x: Vec<f64> = (0..4).map(|d| (x[d] - mean.2[d]) / (var.2[d] + 1e-8).sqrt()).collect();
    let z = affine(&wm.2, None, &x);
    let (mean, sampled) = actions(&path);
    close(mean, &[z[0].clamp(-1.0, 1.0), z[1].clamp(-1.0, 1.0)]);
    assert_eq!(mean, sampled);
}

#[test]
fn unknown_and_incomplete_files_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("policy.npz");
    let refuses = |texts: &[(&str, &str)], arrays: &[Array], needle: &str| {
        write(&path, texts, arrays, Order::C);
        let error = Policy::load(&path).unwrap_err().to_string();
        assert!(error.contains("policy.npz") && error.contains(needle), "{error}");
    };
    refuses(&[], &weights(), "kind");
    refuses(&[("kind", "dqn")], &weights(), "'dqn'");
    refuses(&[("kind", "sac_tanh_gaussian")], &weights(), "ws");
    refuses(&[("kind", "sac_tanh_gaussian")], &weights()[..3], "wm");
    let mut wrong = weights();
    wrong.extend([numbers("ws", &[2, 4], 0.1), numbers("bs", &[2], 0.1)]);
    refuses(&[("kind", "sac_tanh_gaussian")], &wrong, "expected");
    std::fs::write(&path, b"PK not really").unwrap();
    assert!(Policy::load(&path).is_err());
}

#[test]
fn every_shared_policy_loads_and_acts_in_the_box() {
    let shared = std::env::var_os("TCE_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared")), PathBuf::from);
    let Ok(files) = std::fs::read_dir(shared.join("policies")) else {
        eprintln!("SKIPPED: every_shared_policy_loads_and_acts_in_the_box needs TCE_SHARED");
        return;
    };
    let mut kinds = [0; 3];
    for path in files.map(|f| f.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "npz")) {
        let policy = Policy::load(&path).unwrap_or_else(|e| panic!("{e}"));
        let PolicyKind::Mlp(mlp) = policy.kind() else { panic!("{}", path.display()) };
        let spec = mlp.spec();
        kinds[match spec.head {
            Head::Mean => 0,
            Head::Gaussian { .. } => 1,
            Head::TanhGaussian => 2,
        }] += 1;
        let mut o = vec![0.0; 3 * spec.observations];
        fill_normal(&mut Streams::new(0).stream("o"), &mut o);
        let mut a = vec![9.0; 3 * spec.actions];
        let mut rngs: Vec<_> = (0..3).map(|i| Streams::new(0).indexed("a", i)).collect();
        policy.act(&o, Some(&mut rngs), &mut a);
        assert!(a.iter().all(|a| a.abs() <= 1.0), "{}", path.display());
        // A second import of our own file gives the same policy.
        let dir = tempfile::tempdir().unwrap();
        let own = dir.path().join("own.safetensors");
        policy.save(&own).unwrap();
        assert_eq!(Policy::load(&own).unwrap().to_parameters(), policy.to_parameters());
    }
    assert!(kinds.iter().all(|&n| n > 0), "{kinds:?}");
}
