//! Networks that change: by an optimiser, or by following another one.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Tensor, TensorData};

use crate::adam::{Adam, AdamConfig};
use crate::params::{NamedParameters, NetworkError, moving_average};
use crate::tensors::host;

/// A network and its optimiser.
pub struct Trained<M> {
    /// Empty only during a step.
    net: Option<M>,
    adam: Adam,
}

impl<M: Module> Trained<M> {
    /// A network that has not seen a step, trained with Adam's default constants.
    pub fn new(net: M) -> Self {
        Self::with(net, AdamConfig::default())
    }

    /// The same, trained with other constants: weight decay, clipped gradients.
    pub fn with(net: M, config: AdamConfig) -> Self {
        Self { net: Some(net), adam: config.init() }
    }

    /// The network.
    pub fn net(&self) -> &M {
        self.net.as_ref().expect("only empty during a step")
    }

    /// One step of Adam down the gradient of `loss`, the sum over members of the members' losses.
    ///
    /// The loss is taken by value: a tensor that still holds the graph would make Adam copy the parameters.
    pub fn step(&mut self, loss: Tensor<1>, lr: f64) {
        let mut grads = loss.backward();
        drop(loss);
        let net = self.net.take().expect("only empty during a step");
        self.net = Some(self.adam.step(lr, net, &mut grads));
    }

    /// [`Trained::step`], then `average` a step of `rate` after the result, in one pass over memory.
    pub fn step_averaged(&mut self, loss: Tensor<1>, lr: f64, average: &mut Averaged<M>, rate: f64) {
        let mut grads = loss.backward();
        drop(loss);
        let net = self.net.take().expect("only empty during a step");
        let slow = average.net.take().expect("only empty while it moves");
        let (net, slow) = self.adam.step_averaged(lr, net, &mut grads, slow, rate);
        (self.net, average.net) = (Some(net), Some(slow));
    }

    /// Adds parameters and moments to `state`.
    pub fn save(&self, name: &str, state: &mut NamedParameters) {
        state.collect(name, self.net());
        let (time, moments) = self.adam.state();
        state.metadata.insert(format!("adam.{name}"), time.to_string());
        for (k, (m, v)) in moments.iter().enumerate() {
            for (part, t) in [("m", m), ("v", v)] {
                state.tensors.insert(format!("adam.{name}.{part}.{k}"), (t.dims().to_vec(), host(t.clone())));
            }
        }
    }

    /// Takes parameters and moments from `state`.
    pub fn load(&mut self, name: &str, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        let missing = |what: String, found: String| NetworkError::Mismatch {
            path: path.to_owned(),
            name: what,
            found,
            expected: "the optimiser's state".into(),
        };
        let key = format!("adam.{name}");
        let found = state.metadata.get(&key).cloned().unwrap_or_else(|| "nothing".into());
        let time = found.parse().map_err(|_| missing(key.clone(), found))?;
        // A file that does not fit leaves the network as it was.
        let net = state.apply(name, self.net().clone(), path)?;
        let device = net.devices()[0].clone().inner();
        let moment = |part: &str, k: usize| -> Option<Tensor<1>> {
            let (shape, data) = state.tensors.get(&format!("{key}.{part}.{k}"))?;
            Some(Tensor::from_data(TensorData::new(data.clone(), shape.clone()), &device))
        };
        let mut moments = Vec::new();
        while let (Some(m), Some(v)) = (moment("m", moments.len()), moment("v", moments.len())) {
            moments.push((m, v));
        }
        let parameters = state.tensors.keys().filter(|k| k.starts_with(&format!("{name}."))).count();
        if time > 0 && moments.len() != parameters {
            return Err(missing(key, format!("the moments of {} of {parameters} parameters", moments.len())));
        }
        self.net = Some(net);
        self.adam.restore(time, moments);
        Ok(())
    }
}

/// A network that follows another one slowly (a target network, an average of the parameters).
pub struct Averaged<M> {
    /// Empty only while it moves.
    net: Option<M>,
}

impl<M: Module> Averaged<M> {
    /// A copy of `online`, outside of autodiff.
    pub fn new(online: &M) -> Self {
        // A moving average of rate 0 owns its memory, which a plain copy would share with `online`.
        Self { net: Some(moving_average(online.valid(), online, 0.0)) }
    }

    /// The network.
    pub fn net(&self) -> &M {
        self.net.as_ref().expect("only empty while it moves")
    }

    /// Takes the parameters from `state`.
    pub fn load(&mut self, name: &str, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net = Some(state.apply(name, self.net().clone(), path)?);
        Ok(())
    }
}
