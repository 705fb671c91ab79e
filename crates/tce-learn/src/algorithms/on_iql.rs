//! Methods that are IQL on other batches: what they do to a batch is theirs, everything else is [`crate::iql`]'s.

use std::path::Path;

use tce_nn::{NamedParameters, NetworkError, Tensor};

use crate::buffer::Minibatch;
use crate::iql::Iql;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter};

/// What a method does to a batch before IQL learns from it.
pub trait BatchTransform: Send {
    /// The batch of `step` that IQL gets, and what multiplies the rows of its L_Q. Networks of the method's own are trained here.
    fn transform(
        &mut self,
        iql: &Iql,
        batch: &Minibatch,
        step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>);

    /// Adds networks of its own to `state`.
    fn save(&self, _state: &mut NamedParameters) {}

    /// Takes them from `state`; `path` is where it came from, for messages.
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
