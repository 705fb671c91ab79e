//! Methods that are IQL on other batches: what they do to a batch is theirs, everything else is [`crate::iql`]'s.

use std::path::Path;

use tce_nn::{NamedParameters, NetworkError, Tensor};

use crate::buffer::Minibatch;
use crate::iql::Iql;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter};

/// What a method does to a batch before IQL learns from it.
pub trait Shape: Send {
    /// The batch of `step` that IQL gets, and what multiplies the rows of its L_Q. Networks of the method's own are trained here.
    fn shape(&mut self, iql: &Iql, batch: &Minibatch, step: u64, meter: &mut Meter) -> (Minibatch, Option<Tensor<3>>);

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

/// IQL on the batches of a [`Shape`].
pub struct OnIql<S> {
    pub(crate) iql: Iql,
    pub(crate) shape: S,
}

impl<S: Shape> Learner for OnIql<S> {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let (batch, weights) = self.shape.shape(&self.iql, batch, step, meter);
        self.iql.step(&batch, weights, step, meter);
    }

    fn state(&self) -> NamedParameters {
        let mut state = self.iql.state();
        self.shape.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.iql.restore(state, path)?;
        self.shape.load(state, path)
    }
}

impl<S: Shape> PolicyLearner for OnIql<S> {
    fn policies(&self) -> Vec<Policy> {
        self.iql.policies()
    }
}
