//! Trained policies that act on arrays.

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray2, PyArrayDyn, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use tce_base::{Rng, Streams};
use tce_learn::{Memory, onnx};
use tce_zoo::actors::read_policy;

use crate::errors::Raise;

/// A policy, ready to act.
#[pyclass(frozen, module = "tce._tce")]
pub struct Policy {
    pub policy: tce_learn::Policy,
}

/// What lanes remember of their episodes, one entry a lane.
#[pyclass(module = "tce._tce")]
pub struct Memories {
    lanes: Vec<Memory>,
}

/// Tensors by their names, and what else the file says.
type Parameters<'py> = (BTreeMap<String, Bound<'py, PyArrayDyn<f32>>>, BTreeMap<String, String>);

#[pymethods]
impl Policy {
    /// Reads a file, or an actor of the zoo (`zoo:NAME`).
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Ok(Self { policy: py.detach(|| read_policy(&path)).or_raise(py)? })
    }

    /// Writes a safetensors file, whole or not at all.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        self.policy.save(&path).or_raise(py)
    }

    /// Lengths of an observation and of an action.
    #[getter]
    fn dims(&self) -> (usize, usize) {
        self.policy.dims()
    }

    /// Least and greatest action of every dimension.
    #[getter]
    fn action_range(&self) -> (Vec<f32>, Vec<f32>) {
        let actions = self.policy.dims().1;
        let range = self.policy.action_range();
        range.map_or_else(|| (vec![-1.0; actions], vec![1.0; actions]), |r| (r.low.clone(), r.high.clone()))
    }

    /// Whether it remembers its episode.
    #[getter]
    fn recurrent(&self) -> bool {
        matches!(self.policy.kind(), tce_learn::PolicyKind::Sequence(_))
    }

    /// Memories of `lanes` episodes that begin.
    fn start(&self, lanes: usize) -> Memories {
        Memories { lanes: vec![self.policy.start(); lanes] }
    }

    /// Actions for a row of observations a lane: mean ones, or sampled ones from the streams of a seed and a call's number.
    fn act<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
        mut memories: PyRefMut<'py, Memories>,
        sample: Option<(u64, u64)>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let (rows, (obs_dim, act_dim)) = (observations.shape()[0], self.policy.dims());
        if observations.shape()[1] != obs_dim || memories.lanes.len() != rows {
            let found = format!("{rows} x {} with {} memories", observations.shape()[1], memories.lanes.len());
            return Err(PyValueError::new_err(format!(
                "observations: found {found}, expected N x {obs_dim} with N memories"
            )));
        }
        let observations: Vec<f32> = observations.as_array().iter().copied().collect();
        let mut actions = vec![0.0; rows * act_dim];
        let lanes = &mut memories.lanes;
        py.detach(|| {
            let mut rngs: Option<Vec<Rng>> = sample.map(|(seed, call)| {
                let streams = Streams::new(seed).child(&format!("act {call}"));
                (0..rows as u64).map(|row| streams.indexed("row", row)).collect()
            });
            self.policy.act_with(&observations, lanes, rngs.as_deref_mut(), &mut actions);
        });
        Ok(Array2::from_shape_vec((rows, act_dim), actions).expect("whole rows").into_pyarray(py))
    }

    /// Tensors and metadata, as the file has them.
    fn parameters<'py>(&self, py: Python<'py>) -> Parameters<'py> {
        let parameters = self.policy.to_parameters();
        let tensor = |(name, (shape, values)): (String, (Vec<usize>, Vec<f32>))| {
            let array = numpy::ndarray::ArrayD::from_shape_vec(shape, values).expect("a whole tensor");
            (name, array.into_pyarray(py))
        };
        (parameters.tensors.into_iter().map(tensor).collect(), parameters.metadata.into_iter().collect())
    }

    /// Writes an ONNX model, whole or not at all.
    fn save_onnx(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        onnx::save(&self.policy, &path).or_raise(py)
    }

    fn __reduce__<'py>(this: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, (Vec<u8>,))> {
        let bytes = this.get().policy.to_parameters().to_bytes();
        Ok((this.py().get_type::<Self>().getattr("of_bytes")?, (bytes,)))
    }

    /// A policy out of the bytes of its file.
    #[staticmethod]
    fn of_bytes(py: Python<'_>, bytes: &[u8]) -> PyResult<Self> {
        let path = std::path::Path::new("(pickled)");
        let parameters = tce_nn::NamedParameters::from_bytes(bytes, path).or_raise(py)?;
        Ok(Self { policy: tce_learn::Policy::from_parameters(&parameters, path).or_raise(py)? })
    }
}

#[pymethods]
impl Memories {
    fn __len__(&self) -> usize {
        self.lanes.len()
    }

    /// Begins the episodes of the marked lanes anew.
    fn restart(&mut self, policy: &Policy, marked: PyReadonlyArray1<'_, bool>) {
        let marked = marked.as_array();
        for (lane, _) in self.lanes.iter_mut().zip(marked).filter(|(_, marked)| **marked) {
            *lane = policy.policy.start();
        }
    }

    /// Tells every lane the reward of its last action.
    fn reward(&mut self, policy: &Policy, rewards: PyReadonlyArray1<'_, f64>) {
        for (lane, reward) in self.lanes.iter_mut().zip(rewards.as_array()) {
            policy.policy.reward(lane, *reward);
        }
    }
}
