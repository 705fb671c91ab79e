//! Policies without a memory: multi-layer perceptrons from observations to actions.
//!
//! x = clip((o - mean) / std) over the input dimensions, z = MLP(x), then an action in the box [-1, 1]:
//!
//! | head | mean action | sampled action (n ~ N(0, I)) | used by |
//! |---|---|---|---|
//! | [`Head::Mean`] | clip(z) | the same | deterministic tanh policies (BC, IQL of OTDF); ARS |
//! | [`Head::Gaussian`] | clip(z) | clip(z + σ n) | IQL of its authors, PPO, TRPO, A2C |
//! | [`Head::TanhGaussian`] | tanh(μ), z = (μ, ln σ) | tanh(μ + σ n), ln σ clipped to [-20, 2] or to `log_std_range` | SAC, OTDF; clones by likelihood |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::{Rng, Streams, random::fill_normal};
use tce_data::Standardizer;
use tce_nn::{Activation, Mlp, MlpConfig, Module, NamedParameters, cpu, host, tensor};

use crate::error::LearnError;

/// Range of ln σ of a state-dependent Gaussian head, unless [`PolicySpec::log_std_range`] gives another.
pub const LOG_STD_RANGE: (f32, f32) = (-20.0, 2.0);

/// Key of the specification in a policy file's metadata.
pub(crate) const KEY: &str = "policy";

/// How the network's output becomes an action.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Head {
    /// The output, clipped to the box.
    Mean,
    /// Normal around the output with a standard deviation that does not depend on the state.
    Gaussian {
        /// ln σ, one per action dimension.
        log_std: Vec<f32>,
    },
    /// Normal with mean and ln σ from the network (2 outputs per action), squashed by tanh.
    TanhGaussian,
}

/// The specification of a policy: everything except its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicySpec {
    /// Length of an observation.
    pub observations: usize,
    /// Length of an action.
    pub actions: usize,
    /// The observation dimensions that the network sees, ascending.
    pub inputs: Vec<usize>,
    /// Covers all observation dimensions.
    pub standardizer: Standardizer,
    /// Bound on the absolute value of a standardised input.
    pub clip: Option<f32>,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Activation of the hidden layers.
    pub activation: Activation,
    /// Activation of the output layer.
    pub output_activation: Activation,
    /// Converts the output to an action.
    pub head: Head,
    /// Range of ln σ of [`Head::TanhGaussian`], if it was trained in another one than [`LOG_STD_RANGE`]. Files of other
    /// policies do not have this key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub log_std_range: Option<(f32, f32)>,
}

impl PolicySpec {
    /// The network that this specification describes.
    pub fn network(&self) -> MlpConfig {
        let outputs = if self.head == Head::TanhGaussian { 2 * self.actions } else { self.actions };
        MlpConfig::relu(self.inputs.len(), &self.hidden, outputs)
            .with_activation(self.activation)
            .with_output_activation(self.output_activation)
    }

    fn fault(&self) -> Option<(&'static str, String, String)> {
        let n = self.observations;
        if self.actions == 0 || self.inputs.is_empty() {
            return Some((
                "actions, inputs",
                format!("{}, {:?}", self.actions, self.inputs),
                "at least one each".into(),
            ));
        }
        if self.inputs.iter().any(|&d| d >= n) {
            return Some(("inputs", format!("{:?}", self.inputs), format!("dimensions below {n}")));
        }
        let z = &self.standardizer;
        if z.mean.len() != n || z.std.len() != n || z.std.iter().any(|s| s.is_nan() || *s <= 0.0) {
            let found = format!("{} means, {} divisors", z.mean.len(), z.std.len());
            return Some(("standardizer", found, format!("{n} of each, divisors positive")));
        }
        if let Some(clip) = self.clip.filter(|clip| clip.is_nan() || *clip < 0.0) {
            return Some(("clip", clip.to_string(), "a number from 0 on".into()));
        }
        let none = |(low, high): &(f32, f32)| low.is_nan() || high.is_nan() || low > high;
        if let Some((low, high)) = self.log_std_range.filter(none) {
            return Some(("log_std_range", format!("{low}, {high}"), "two numbers, the lower one first".into()));
        }
        match &self.head {
            Head::Gaussian { log_std } if log_std.len() != self.actions => {
                Some(("log_std", format!("{} numbers", log_std.len()), format!("{}", self.actions)))
            }
            _ => None,
        }
    }
}

/// One policy, ready to act.
#[derive(Clone, Debug)]
pub struct MlpPolicy {
    spec: PolicySpec,
    network: Mlp,
}

impl MlpPolicy {
    /// A policy with the given weights, named `{prefix}.layers.{k}.weight` and `.bias`; `path` is for messages.
    ///
    /// # Errors
    /// If the specification contradicts itself or the weights do not fit it.
    pub fn new(spec: PolicySpec, weights: &NamedParameters, prefix: &str, path: &Path) -> Result<Self, LearnError> {
        if let Some((field, found, expected)) = spec.fault() {
            let (path, field) = (path.to_owned(), field.to_owned());
            let remedy = "the file contradicts itself: write it anew".to_owned();
            return Err(LearnError::Policy { path, field, found, expected, remedy });
        }
        let blank = spec.network().init(&[Streams::new(0)], "policy", &cpu());
        let network = weights.apply(prefix, blank, path)?;
        Ok(Self { spec, network })
    }

    /// One network whose last layer outputs the mean of the last layers of `policies`, before the output activation.
    /// Its hidden layers have the sum of their widths; all weights between different policies are zero.
    ///
    /// # Panics
    /// If `policies` is empty, or they differ in more than their weights.
    pub fn average(policies: &[&Self]) -> Self {
        let (first, count) = (policies[0], policies.len());
        assert!(policies.iter().all(|p| p.spec == first.spec), "policies of one kind");
        let hidden: Vec<usize> = first.spec.hidden.iter().map(|h| h * count).collect();
        let spec = PolicySpec { hidden, ..first.spec.clone() };
        let all: Vec<NamedParameters> = policies.iter().map(|p| p.to_parameters()).collect();
        let last = spec.hidden.len();
        let mut wide = NamedParameters::default();
        for layer in 0..=last {
            let of = |part: &str| {
                let name = format!("{KEY}.layers.{layer}.{part}");
                let tensors = all.iter().map(|p| &p.tensors[&name]).collect::<Vec<_>>();
                (name, tensors)
            };
            let (name, weights) = of("weight");
            let (rows, columns) = (weights[0].0[1], weights[0].0[2]);
            // The policies share the input of the first layer and the output of the last layer.
            let (down, across) = (if layer == 0 { 0 } else { rows }, if layer == last { 0 } else { columns });
            let (tall, broad) = (rows + down * (count - 1), columns + across * (count - 1));
            let share = if layer == last { 1.0 / count as f32 } else { 1.0 };
            let mut values = vec![0.0; tall * broad];
            for (k, (_, own)) in weights.iter().enumerate() {
                for (i, row) in own.chunks_exact(columns).enumerate() {
                    let start = (k * down + i) * broad + k * across;
                    values[start..start + columns].iter_mut().zip(row).for_each(|(v, w)| *v += w * share);
                }
            }
            wide.tensors.insert(name, (vec![1, tall, broad], values));
            let (name, biases) = of("bias");
            let mut values = vec![0.0; broad];
            for (k, (_, own)) in biases.iter().enumerate() {
                values[k * across..k * across + columns].iter_mut().zip(own).for_each(|(v, b)| *v += b * share);
            }
            wide.tensors.insert(name, (vec![1, 1, broad], values));
        }
        Self::new(spec, &wide, KEY, Path::new("an average")).expect("a network of this specification")
    }

    /// The specification.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// The policy in the parameters of a file; `path` is for messages.
    ///
    /// # Errors
    /// If the parameters are not a policy.
    pub fn from_parameters(parameters: &NamedParameters, path: &Path) -> Result<Self, LearnError> {
        let fault = |found: String| LearnError::Policy {
            path: path.to_owned(),
            field: KEY.into(),
            found,
            expected: "a policy's specification".into(),
            remedy: "give a file written by `tce learn`".into(),
        };
        let text = parameters.metadata.get(KEY).ok_or_else(|| fault("nothing".into()))?;
        let spec = serde_json::from_str(text).map_err(|e| fault(e.to_string()))?;
        Self::new(spec, parameters, KEY, path)
    }

    /// The weights, with the specification in the metadata.
    pub fn to_parameters(&self) -> NamedParameters {
        let mut out = NamedParameters::default();
        out.collect(KEY, &self.network);
        let json = serde_json::to_string(&self.spec).expect("plain numbers");
        out.metadata.insert(KEY.into(), json);
        out
    }

    /// Fills `actions` `[rows, d_a]` for `observations` `[rows, d_s]`, both row-major: with mean actions, or with
    /// sampled ones if there is one generator per row. The result of a row depends only on that row and its generator.
    ///
    /// # Panics
    /// If the lengths do not match.
    pub fn act(&self, observations: &[f32], rngs: Option<&mut [Rng]>, actions: &mut [f32]) {
        let spec = &self.spec;
        let rows = observations.len() / spec.observations;
        assert_eq!((rows * spec.observations, rows * spec.actions), (observations.len(), actions.len()));
        if rows == 0 {
            return;
        }
        let z = &spec.standardizer;
        let bound = spec.clip.unwrap_or(f32::INFINITY);
        let (low, high) = spec.log_std_range.unwrap_or(LOG_STD_RANGE);
        let mut x = Vec::with_capacity(rows * spec.inputs.len());
        for row in observations.chunks_exact(spec.observations) {
            x.extend(spec.inputs.iter().map(|&d| ((row[d] - z.mean[d]) / z.std[d]).clamp(-bound, bound)));
        }
        let out = host(self.network.forward(tensor(x, [1, rows, spec.inputs.len()], &cpu())));
        let a = spec.actions;
        let mut noise = vec![0.0; rows * a];
        if let Some(rngs) = rngs {
            assert_eq!(rngs.len(), rows, "one generator per row");
            noise.chunks_exact_mut(a).zip(rngs).for_each(|(noise, rng)| fill_normal(rng, noise));
        }
        let rows = actions.chunks_exact_mut(a).zip(out.chunks_exact(out.len() / rows)).zip(noise.chunks_exact(a));
        for ((action, out), noise) in rows {
            for d in 0..a {
                action[d] = match &spec.head {
                    Head::Mean => out[d].clamp(-1.0, 1.0),
                    Head::Gaussian { log_std } => (out[d] + log_std[d].exp() * noise[d]).clamp(-1.0, 1.0),
                    Head::TanhGaussian => {
                        let log_std = out[a + d].clamp(low, high);
                        (out[d] + log_std.exp() * noise[d]).tanh()
                    }
                };
            }
        }
    }
}

/// Splits a population into policies: member m gets the m-th network of `networks` and the m-th specification.
pub(crate) fn from_population<M: Module>(specs: Vec<PolicySpec>, networks: &M) -> Vec<MlpPolicy> {
    let mut all = NamedParameters::default();
    all.collect(KEY, networks);
    let policy = |(m, spec)| MlpPolicy::new(spec, &all.member(m), KEY, Path::new("(in memory)"));
    let made = |x| policy(x).expect("the networks were made from the specification");
    specs.into_iter().enumerate().map(made).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(head: Head) -> PolicySpec {
        PolicySpec {
            observations: 3,
            actions: 2,
            inputs: vec![0, 2],
            standardizer: Standardizer {
                mean: vec![1.0, 0.0, -1.0],
                std: vec![2.0, 1.0, 0.5],
                ..Standardizer::identity(3)
            },
            clip: Some(3.0),
            hidden: vec![64],
            activation: Activation::Relu,
            output_activation: Activation::Identity,
            head,
            log_std_range: None,
        }
    }

    fn policy(head: Head) -> MlpPolicy {
        let spec = spec(head);
        let network = spec.network().init(&[Streams::new(5)], "policy", &cpu());
        from_population(vec![spec], &network).remove(0)
    }

    #[test]
    fn an_average_acts_by_the_mean_output() {
        let tanh = PolicySpec { output_activation: Activation::Tanh, hidden: vec![16, 8], ..spec(Head::Mean) };
        let policies = [5, 6, 7].map(|seed| {
            let network = tanh.network().init(&[Streams::new(seed)], "policy", &cpu());
            from_population(vec![tanh.clone()], &network).remove(0)
        });
        let average = MlpPolicy::average(&policies.iter().collect::<Vec<_>>());
        assert_eq!(average.spec().hidden, [48, 24]);
        let act = |p: &MlpPolicy| {
            let mut actions = vec![0.0; 8];
            p.act(&observations(4), None, &mut actions);
            actions
        };
        let each = policies.each_ref().map(act);
        for (k, a) in act(&average).iter().enumerate() {
            let expected = (each.iter().map(|e| f64::from(e[k]).atanh()).sum::<f64>() / 3.0).tanh();
            assert!((f64::from(*a) - expected).abs() < 1e-5, "{a} {expected}");
        }
    }

    fn observations(rows: usize) -> Vec<f32> {
        let mut o = vec![0.0; rows * 3];
        fill_normal(&mut Streams::new(1).stream("o"), &mut o);
        o
    }

    #[test]
    fn a_row_does_not_depend_on_the_others() {
        for head in [Head::Mean, Head::Gaussian { log_std: vec![-1.0, 0.0] }, Head::TanhGaussian] {
            let (policy, o) = (policy(head), observations(37));
            let rngs: Vec<_> = (0..37).map(|i| Streams::new(2).indexed("act", i)).collect();
            let (mut all, mut one) = (vec![0.0; 74], vec![0.0; 74]);
            policy.act(&o, Some(&mut rngs.clone()), &mut all);
            for (i, out) in one.chunks_mut(2).enumerate() {
                policy.act(&o[i * 3..][..3], Some(&mut rngs.clone()[i..=i]), out);
            }
            let far = all.iter().zip(&one).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(far < 1e-6, "{far}");
        }
    }

    /// In a range of one number, that number is ln σ at every state.
    #[test]
    fn a_range_of_its_own_is_kept_in_the_file() {
        let wide = policy(Head::TanhGaussian);
        let mut spec = wide.spec().clone();
        assert!(!serde_json::to_string(&spec).unwrap().contains("range"), "files of other policies stay as they are");
        spec.log_std_range = Some((-1.5, -1.5));
        let own = MlpPolicy::new(spec.clone(), &wide.to_parameters(), KEY, Path::new("x")).unwrap();
        let own = MlpPolicy::from_parameters(&own.to_parameters(), Path::new("x")).unwrap();
        assert_eq!(own.spec(), &spec);
        let (o, rng) = (observations(4), |i: usize| Streams::new(2).indexed("act", i as u64));
        let (mut mean, mut sampled) = (vec![0.0; 8], vec![0.0; 8]);
        own.act(&o, None, &mut mean);
        own.act(&o, Some(&mut (0..4).map(rng).collect::<Vec<_>>()), &mut sampled);
        for i in 0..4 {
            let mut n = [0.0; 2];
            fill_normal(&mut rng(i), &mut n);
            for d in 0..2 {
                let expected = (mean[2 * i + d].atanh() + (-1.5f32).exp() * n[d]).tanh();
                assert!((sampled[2 * i + d] - expected).abs() < 1e-5);
            }
        }
        spec.log_std_range = Some((1.0, -1.0));
        let error = MlpPolicy::new(spec, &wide.to_parameters(), KEY, Path::new("x")).unwrap_err().to_string();
        assert!(error.contains("log_std_range: found 1, -1"), "{error}");
    }

    #[test]
    fn heads_follow_their_formulas() {
        let o = observations(4);
        for head in [Head::Mean, Head::Gaussian { log_std: vec![-1.0, 0.5] }, Head::TanhGaussian] {
            let policy = policy(head.clone());
            let weights = policy.to_parameters().tensors;
            let w = |k: usize, part: &str| weights[&format!("policy.layers.{k}.{part}")].1.clone();
            let (w0, b0, w1, b1) = (w(0, "weight"), w(0, "bias"), w(1, "weight"), w(1, "bias"));
            let outputs = b1.len();
            let (mut mean, mut sampled) = (vec![0.0; 8], vec![0.0; 8]);
            policy.act(&o, None, &mut mean);
            let rng = |i: usize| Streams::new(2).indexed("act", i as u64);
            policy.act(&o, Some(&mut (0..4).map(rng).collect::<Vec<_>>()), &mut sampled);
            for i in 0..4 {
                let x = [(o[3 * i] - 1.0) / 2.0, (o[3 * i + 2] + 1.0) / 0.5].map(|x: f32| x.clamp(-3.0, 3.0));
                let h: Vec<f32> = (0..64).map(|j| (x[0] * w0[j] + x[1] * w0[64 + j] + b0[j]).max(0.0)).collect();
                let z: Vec<f32> =
                    (0..outputs).map(|k| (0..64).map(|j| h[j] * w1[j * outputs + k]).sum::<f32>() + b1[k]).collect();
                let mut n = [0.0; 2];
                fill_normal(&mut rng(i), &mut n);
                for d in 0..2 {
                    let (m, s) = match &head {
                        Head::Mean => (z[d].clamp(-1.0, 1.0), z[d].clamp(-1.0, 1.0)),
                        Head::Gaussian { log_std } => {
                            (z[d].clamp(-1.0, 1.0), (z[d] + log_std[d].exp() * n[d]).clamp(-1.0, 1.0))
                        }
                        Head::TanhGaussian => (z[d].tanh(), (z[d] + z[2 + d].exp() * n[d]).tanh()),
                    };
                    assert!((mean[2 * i + d] - m).abs() < 1e-5 && (sampled[2 * i + d] - s).abs() < 1e-5);
                }
            }
        }
    }
}
