//! Twin critics with target networks (Fujimoto et al. 2018), used by every algorithm here.
//!
//! | symbol | here |
//! |---|---|
//! | Q₁, Q₂ | [`Twins::pair`], 256-256 ReLU on [s, a] |
//! | Q' | [`Critic::target`]: Q' ← (1 - ρ) Q' + ρ Q |
//! | L_Q | Σᵢ mean w (Qᵢ(s, a) - y)² ([`squared_td_error`]) |
//!
//! The two critics share only their input. They are therefore two networks, computed in parallel on two threads,
//! instead of one network with twice the population.

use std::path::Path;

use tce_base::Streams;
use tce_nn::{Averaged, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained};

use crate::losses::squared_td_error;

/// [s, a], the input of critics.
pub fn state_action(s: &Tensor<3>, a: Tensor<3>) -> Tensor<3> {
    Tensor::cat(vec![s.clone(), a], 2)
}

/// A critic and its target network.
pub struct Critic {
    name: &'static str,
    online: Trained<Mlp>,
    target: Averaged<Mlp>,
}

impl Critic {
    fn new(name: &'static str, config: &MlpConfig, members: &[Streams], device: &Device) -> Self {
        let net = config.init(members, name, device);
        Self { name, target: Averaged::new(&net), online: Trained::new(net) }
    }

    /// Q(s, a), `[P, B, 1]`.
    pub fn online(&self, sa: Tensor<3>) -> Tensor<3> {
        self.online.net().forward(sa)
    }

    /// Q'(s, a), `[P, B, 1]`, outside of autodiff.
    pub fn target(&self, sa: Tensor<3>) -> Tensor<3> {
        self.target.net().forward(sa)
    }

    /// Q(s, a) with a gradient for the action but not for the weights.
    pub fn frozen(&self, sa: Tensor<3>) -> Tensor<3> {
        self.online.net().valid().forward(sa)
    }

    /// One step of Q on `loss` of Q(s, a), then one step of Q' towards Q. Returns the loss per member, `[P, 1, 1]`.
    fn step(
        &mut self,
        sa: Tensor<3>,
        loss: &(impl Fn(Tensor<3>) -> Tensor<3> + Sync),
        lr: f64,
        polyak: f64,
    ) -> Tensor<3> {
        let loss = loss(self.online(sa));
        let value = loss.clone().inner();
        self.online.step_averaged(loss.sum(), lr, &mut self.target, polyak);
        value
    }
}

/// Two critics that differ in their initial weights.
pub struct Twins {
    /// Q₁ and Q₂.
    pub pair: [Critic; 2],
}

impl Twins {
    /// New critics on `inputs` observations and `actions`, drawn from the members' streams `critic 1` and `critic 2`.
    /// `device` must support autodiff.
    pub fn new(inputs: usize, actions: usize, hidden: &[usize], members: &[Streams], device: &Device) -> Self {
        Self::with(&MlpConfig::relu(inputs + actions, hidden, 1), members, device)
    }

    /// The same with any network configuration.
    pub fn with(config: &MlpConfig, members: &[Streams], device: &Device) -> Self {
        Self { pair: ["critic 1", "critic 2"].map(|name| Critic::new(name, config, members, device)) }
    }

    /// min(Q₁', Q₂')(s, a), outside of autodiff.
    pub fn lesser_target(&self, sa: Tensor<3>) -> Tensor<3> {
        let [one, two] = &self.pair;
        let (q1, q2) = rayon::join(|| one.target(sa.clone()), || two.target(sa.clone()));
        q1.min_pair(q2)
    }

    /// One step of both critics towards y; `w` `[P, B, 1]` multiplies rows. Returns the sum of the losses per member.
    pub fn step(&mut self, sa: Tensor<3>, y: Tensor<3>, w: Option<Tensor<3>>, lr: f64, polyak: f64) -> Tensor<3> {
        self.step_down(sa, |q| squared_td_error(q, y.clone(), w.clone()), lr, polyak)
    }

    /// One step of both critics on `loss` of Q(s, a), per member `[P, 1, 1]`. Returns the sum of the two losses.
    pub fn step_down(
        &mut self,
        sa: Tensor<3>,
        loss: impl Fn(Tensor<3>) -> Tensor<3> + Sync,
        lr: f64,
        polyak: f64,
    ) -> Tensor<3> {
        let [one, two] = &mut self.pair;
        let other = sa.clone();
        let (a, b) = rayon::join(|| one.step(sa, &loss, lr, polyak), || two.step(other, &loss, lr, polyak));
        a + b
    }

    /// Adds parameters and optimisers to `state`.
    pub fn save(&self, state: &mut NamedParameters) {
        for critic in &self.pair {
            critic.online.save(critic.name, state);
            state.collect(&format!("target {}", critic.name), critic.target.net());
        }
    }

    /// Restores parameters and optimisers from `state`; `path` is its file, for messages.
    ///
    /// # Errors
    /// If they belong to other critics.
    pub fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        for critic in &mut self.pair {
            critic.online.load(critic.name, state, path)?;
            critic.target.load(&format!("target {}", critic.name), state, path)?;
        }
        Ok(())
    }
}
