//! Other devices compute what the CPU's fused operations compute. Built with the feature `vulkan`, for machines with a GPU
//! (Mesa's software driver crashes in burn's matrix products).
#![cfg(feature = "vulkan")]

use std::collections::BTreeMap;

use tce_base::{Streams, random::fill_normal};
use tce_nn::{Activation, AdamConfig, Device, MlpConfig, Module, Tensor, cpu, host, tensor, vulkan};

fn gpu() -> Option<Device> {
    vulkan().map_err(|e| eprintln!("SKIPPED: {e}")).ok()
}

fn normal(name: &str, shape: [usize; 3], device: &Device) -> Tensor<3> {
    let mut data = vec![0.0; shape.iter().product()];
    fill_normal(&mut Streams::new(7).stream(name), &mut data);
    tensor(data, shape, device)
}

fn assert_close(a: &[f32], b: &[f32], tolerance: f32, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    let scale = b.iter().fold(1.0f32, |m, v| m.max(v.abs()));
    // NaN is close to nothing.
    let far =
        a.iter().zip(b).position(|(a, b)| (a - b).abs().partial_cmp(&(tolerance * scale)).is_none_or(|o| o.is_gt()));
    assert!(far.is_none(), "{what}: {:?} at a scale of {scale}", far.map(|i| (a[i], b[i])));
}

#[test]
fn layers_and_their_gradients_are_the_cpus() {
    let Some(gpu) = gpu() else { return };
    for act in [Activation::Identity, Activation::Relu, Activation::Silu, Activation::Tanh] {
        let [a, b] = [&gpu, &cpu()].map(|device| {
            let device = device.clone().autodiff();
            let x = normal("x", [2, 37, 9], &device).require_grad();
            let w = normal("w", [4, 9, 21], &device).require_grad();
            let bias = normal("b", [4, 1, 21], &device).require_grad();
            let (scale, shift) =
                (normal("s", [4, 1, 21], &device).require_grad(), normal("t", [4, 1, 21], &device).require_grad());
            let y = tce_nn::dense(x.clone(), w.clone(), bias.clone(), act);
            let y = tce_nn::layer_norm(y, scale.clone(), shift.clone());
            let grads = (y.clone() * normal("g", [4, 37, 21], &device)).sum().backward();
            let mut out = vec![host(y)];
            out.extend([x, w, bias, scale, shift].map(|t| host(t.grad(&grads).expect("a gradient"))));
            out
        });
        for (k, (a, b)) in a.iter().zip(&b).enumerate() {
            assert_close(a, b, 1e-4, &format!("{act:?}, tensor {k}"));
        }
    }
}

#[test]
fn a_population_learns_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let members: Vec<_> = (0..3).map(Streams::new).collect();
    let [a, b] = [&gpu, &cpu()].map(|device| {
        let inner = device.clone();
        let device = device.clone().autodiff();
        let mut net = MlpConfig::relu(9, &[32, 32], 4).init(&members, "n", &device);
        let mut average = net.valid();
        let config = AdamConfig { weight_decay: 0.01, ..AdamConfig::default() };
        let mut adam = config.init();
        let (x, y) = (normal("x", [3, 64, 9], &device), normal("y", [3, 64, 4], &device));
        let mut losses = Vec::new();
        for _ in 0..30 {
            let loss = (net.forward(x.clone()) - y.clone()).square().mean_dim(1).mean_dim(2).sum();
            losses.extend(host(loss.clone()));
            let mut grads = loss.backward();
            (net, average) = adam.step_averaged(1e-2, net, &mut grads, average, 0.1);
        }
        (losses, host(average.forward(normal("z", [3, 5, 9], &inner))))
    });
    assert!(b.0[29] < 0.8 * b.0[0], "it learns: {:?}", b.0);
    assert_close(&a.0, &b.0, 1e-3, "losses");
    assert_close(&a.1, &b.1, 1e-2, "outputs of the average");
}

/// The same figures as on the CPU through the program itself, for a learner with a preparation and two seeds in one set of tensors.
#[test]
fn a_learning_has_the_cpus_figures() {
    if gpu().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let [a, b] = ["vulkan", "cpu"].map(|device| {
        let mut args =
            vec!["--device", device, "learn", "--no-verdict", "--target", "target.hdf5", "--extra", "source.hdf5"];
        args.extend(["--learner", "otdf", "--seeds", "2", "--out", device]);
        args.extend(["--set=learner.steps=20", "--set=learner.batch=32", "--set=learner.behaviour.cvae.steps=20"]);
        let output = crate::common::tce(dir.path(), &args);
        assert!(output.status.success(), "{}", crate::common::message(&output));
        let text = std::fs::read_to_string(dir.path().join(device).join("metrics.jsonl")).unwrap();
        let figures = |line| -> BTreeMap<String, serde_json::Value> { serde_json::from_str(line).unwrap() };
        let mut lines: Vec<_> = text.lines().map(figures).collect();
        lines.sort_by_key(|l| (l["stage"].to_string(), l["step"].as_u64(), l["member"].as_u64()));
        lines
    });
    assert!(a.len() == b.len() && b.len() >= 8, "{} lines, {}", a.len(), b.len());
    for (a, b) in a.iter().zip(&b) {
        for (name, b) in b {
            match b.as_f64() {
                Some(b) => assert_close(&[a[name].as_f64().unwrap() as f32], &[b as f32], 1e-2, name),
                None => assert_eq!(a[name], *b),
            }
        }
    }
}
