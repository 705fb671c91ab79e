//! Methods that are IQL on modified batches. A method changes only the batch; the rest is [`crate::iql`].

use std::path::Path;

use tce_nn::{NamedParameters, NetworkError, Tensor};

use crate::buffer::Minibatch;
use crate::iql::Iql;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter};

/// Changes a batch before IQL learns from it.
pub trait BatchTransform: Send {
    /// Returns the batch of `step` for IQL and its rows' weights in L_Q. The method's own networks are trained here.
    fn transform(
        &mut self,
        iql: &Iql,
        batch: &Minibatch,
        step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>);

    /// Adds the method's own networks to `state`.
    fn save(&self, _state: &mut NamedParameters) {}

    /// Restores them from `state`; `path` is its file, for messages.
    ///
    /// # Errors
    /// If they belong to other networks.
    fn load(&mut self, _state: &NamedParameters, _path: &Path) -> Result<(), NetworkError> {
        Ok(())
    }
}

/// IQL on the batches of a [`BatchTransform`].
pub struct OnIql<S> {
    pub(crate) iql: Iql,
    pub(crate) transform: S,
}

impl<S: BatchTransform> Learner for OnIql<S> {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let (batch, weights) = self.transform.transform(&self.iql, batch, step, meter);
        self.iql.step(&batch, weights, step, meter);
    }

    fn state(&self) -> NamedParameters {
        let mut state = self.iql.state();
        self.transform.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.iql.restore(state, path)?;
        self.transform.load(state, path)
    }
}

impl<S: BatchTransform> PolicyLearner for OnIql<S> {
    fn policies(&self) -> Vec<Policy> {
        self.iql.policies()
    }
}
