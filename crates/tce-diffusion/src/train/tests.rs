use super::*;
use crate::Balance;
use crate::{Condition, Edm, Part, Ve, Vp};
use std::collections::BTreeMap;
use tce_nn::burn::module::{ModuleVisitor, Param};
use tce_nn::burn::tensor::Gradients;
use tce_nn::{Checkpoints, cpu};

fn small() -> NetworkConfig {
    NetworkConfig { width: 32, embedding: 16, blocks: 2, ..NetworkConfig::new(3, 2) }
}

fn rows(n: usize) -> (Vec<f32>, Vec<f32>) {
    let (mut x, mut c) = (vec![0.0; n * 3], vec![0.0; n * 2]);
    fill_normal(&mut Streams::new(1).stream("x"), &mut x);
    fill_normal(&mut Streams::new(1).stream("c"), &mut c);
    (x, c)
}

struct Collected<'a> {
    path: Vec<String>,
    grads: &'a Gradients,
    out: BTreeMap<String, Vec<f32>>,
}

impl ModuleVisitor for Collected<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }
    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.out.insert(self.path.join("."), host(param.val().grad(self.grads).expect("every parameter counts")));
    }
}

/// ⟨∇L, v⟩ against (L(θ + hv) − L(θ − hv)) / 2h for a random direction v within every single parameter.
#[test]
fn gradients_follow_finite_differences() {
    let (x, c) = rows(64);
    let data = [ScoreData::conditioned(&x, 3, &c, 2).unwrap()];
    for process in [Process::Ve(Ve::default()), Process::Vp(Vp::default()), Process::Edm(Edm::default())] {
        let trainer = Trainer::new("t", small(), process, TrainConfig::default(), &[Streams::new(3)], &cpu()).unwrap();
        let loss = denoising_loss(trainer.network.net(), trainer.batch(&data, "train/t", trainer.step));
        let grads = loss.sum().backward();
        let mut collected = Collected { path: vec!["n".into()], grads: &grads, out: BTreeMap::new() };
        trainer.network.net().visit(&mut collected);
        let mut here = NamedParameters::default();
        here.collect("n", trainer.network.net());
        assert_eq!(here.tensors.keys().collect::<Vec<_>>(), collected.out.keys().collect::<Vec<_>>());
        for (name, grad) in &collected.out {
            let mut v = vec![0.0; grad.len()];
            fill_normal(&mut Streams::new(4).stream(name), &mut v);
            // Partly along the gradient, so that the derivative stands out of the rounding of an f32 loss.
            let norm = |v: &[f32]| v.iter().map(|v| v * v).sum::<f32>().sqrt();
            let (of_v, of_g) = (norm(&v), norm(grad).max(1e-12));
            v.iter_mut().zip(grad).for_each(|(v, g)| *v = *v / of_v + g / of_g);
            let h = 1e-2;
            let at = |sign: f32| {
                let mut moved = here.clone();
                let values = &mut moved.tensors.get_mut(name).unwrap().1;
                values.iter_mut().zip(&v).for_each(|(p, v)| *p += sign * h * v);
                let network = moved.apply("n", trainer.network.net().clone(), Path::new("t")).unwrap();
                host(denoising_loss(&network, trainer.batch(&data, "train/t", trainer.step)))[0] as f64
            };
            let difference = (at(1.0) - at(-1.0)) / (2.0 * h as f64);
            let exact: f64 = grad.iter().zip(&v).map(|(g, v)| *g as f64 * *v as f64).sum();
            assert!((difference - exact).abs() < 0.01 * exact.abs() + 5e-5, "{name}: {difference} {exact}");
        }
    }
}

fn values(trainer: &Trainer) -> NamedParameters {
    trainer.model().parameters()
}

#[test]
fn a_restored_training_continues_to_the_byte() {
    let (x, c) = rows(50);
    let data = [ScoreData::conditioned(&x, 3, &c, 2).unwrap()];
    let members = [Streams::new(1), Streams::new(2)];
    let config = TrainConfig { batch: 16, ..TrainConfig::default() };
    let fresh = || Trainer::new("t", small(), Process::Vp(Vp::default()), config, &members, &cpu()).unwrap();
    let mut straight = fresh();
    let mut losses = Vec::new();
    straight.train(&data, 120, &mut Checkpoints::none(), |step, l| losses.push((step, l.to_vec()))).unwrap();
    assert_eq!(losses.iter().map(|(s, l)| (*s, l.len())).collect::<Vec<_>>(), [(100, 2), (120, 2)]);
    let mut first = fresh();
    first.train(&data, 70, &mut Checkpoints::none(), |_, _| {}).unwrap();
    let state = NamedParameters::from_bytes(&first.state().to_bytes(), Path::new("s")).unwrap();
    let mut second = fresh();
    second.restore(&state, Path::new("s")).unwrap();
    second.train(&data, 120, &mut Checkpoints::none(), |_, _| {}).unwrap();
    assert_eq!(values(&straight), values(&second));
    let error = fresh().restore(&NamedParameters::default(), Path::new("s")).unwrap_err().to_string();
    assert!(error.contains("no 'step'"), "{error}");
}

#[test]
fn members_learn_as_they_would_alone() {
    let (x, c) = rows(50);
    let data = [ScoreData::conditioned(&x, 3, &c, 2).unwrap()];
    let config = TrainConfig { batch: 16, ..TrainConfig::default() };
    let run = |members: &[Streams]| {
        let process = Process::Edm(Edm::default());
        let mut trainer = Trainer::new("t", small(), process, config, members, &cpu()).unwrap();
        trainer.train(&data, 20, &mut Checkpoints::none(), |_, _| {}).unwrap();
        values(&trainer)
    };
    let (both, alone) = (run(&[Streams::new(1), Streams::new(2)]).member(1), run(&[Streams::new(2)]));
    for (name, (_, values)) in &alone.tensors {
        for (a, b) in values.iter().zip(&both.tensors[name].1) {
            assert!((a - b).abs() < 1e-5, "{name}: {a} {b}");
        }
    }
}

#[test]
fn misfits_are_refused() {
    let (x, _) = rows(50);
    let part = Part { rows: &x, condition: Condition::Constant(vec![0.0]) };
    let data = [ScoreData::new(vec![part], 3, 1, Balance::Parts).unwrap()];
    let process = Process::Vp(Vp::default());
    let new = |config| Trainer::new("t", small(), process, config, &[Streams::new(1)], &cpu());
    let error = new(TrainConfig::default())
        .unwrap()
        .train(&data, 1, &mut Checkpoints::none(), |_, _| {})
        .unwrap_err()
        .to_string();
    assert_eq!(error, "data of t: found rows of 3 under conditions of 1, expected rows of 3 under conditions of 2");
    let error = new(TrainConfig { ema: 1.0, ..TrainConfig::default() }).err().unwrap().to_string();
    assert_eq!(error, "train.ema: found 1, expected at least 0 and less than 1");
}
