//! The benchmark's environments.

use std::sync::{Mutex, PoisonError};

use numpy::{PyArray1, PyReadonlyArray1, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use tce_base::Streams;
use tce_data::{ScoreTable, parse_environment};
use tce_run::Error;
use tce_zoo::actors::{Actions, Arena, evaluate as rolled_out};

use crate::errors::{Raise, exception};
use crate::policy::Policy;
use crate::work::{Progress, attended};

/// One simulated robot.
#[pyclass(frozen, module = "tce._tce")]
pub struct Env {
    robot: Mutex<tce_sim::Env>,
    dims: (usize, usize),
}

fn environment(name: &str) -> Result<(tce_data::Agent, tce_data::Shift), Error> {
    parse_environment(name).map_err(|e| Error::Usage(format!("env: {e}")))
}

#[pymethods]
impl Env {
    #[new]
    fn new(py: Python<'_>, name: &str) -> PyResult<Self> {
        let (agent, shift) = environment(name).or_raise(py)?;
        Ok(Self { robot: Mutex::new(tce_sim::Env::new(agent, shift).or_raise(py)?), dims: agent.dims() })
    }

    /// Lengths of an observation and of an action.
    #[getter]
    fn dims(&self) -> (usize, usize) {
        self.dims
    }

    /// Steps after which an episode is cut.
    #[classattr]
    const LIMIT: usize = tce_sim::EPISODE_LIMIT;

    /// Puts the robot at its start, with the noise of episode `episode` of `seed`; the observation.
    fn reset<'py>(&self, py: Python<'py>, seed: u64, episode: u64) -> Bound<'py, PyArray1<f32>> {
        let mut observation = vec![0.0; self.dims.0];
        let mut rng = Streams::new(seed).indexed("gymnasium reset", episode);
        self.robot.lock().unwrap_or_else(PoisonError::into_inner).reset(&mut rng, &mut observation);
        PyArray1::from_vec(py, observation)
    }

    /// One step: observation, reward, terminal, and whether the physics blew up.
    fn step<'py>(
        &self,
        py: Python<'py>,
        action: PyReadonlyArray1<'py, f32>,
    ) -> PyResult<(Bound<'py, PyArray1<f32>>, f64, bool, bool)> {
        if action.len() != self.dims.1 {
            let words = format!("action: found {} numbers, expected {}", action.len(), self.dims.1);
            return Err(PyValueError::new_err(words));
        }
        let action: Vec<f32> = action.as_array().iter().copied().collect();
        let mut observation = vec![0.0; self.dims.0];
        let result = self.robot.lock().unwrap_or_else(PoisonError::into_inner).step(&action, &mut observation);
        Ok((PyArray1::from_vec(py, observation), result.reward, result.terminal, result.unstable))
    }

    /// Coordinates and velocities of MuJoCo.
    fn state(&self) -> (Vec<f64>, Vec<f64>) {
        let robot = self.robot.lock().unwrap_or_else(PoisonError::into_inner);
        (robot.qpos().to_vec(), robot.qvel().to_vec())
    }
}

/// Returns, lengths and score of a policy in the environment `env`, as JSON.
#[pyfunction]
pub fn evaluate(
    py: Python<'_>,
    policy: &Policy,
    env: &str,
    episodes: usize,
    seed: u64,
    deterministic: bool,
    progress: Progress,
) -> PyResult<String> {
    let (agent, shift) = environment(env).or_raise(py)?;
    if policy.policy.dims() != agent.dims() {
        let (found, expected) = (policy.policy.dims(), agent.dims());
        let words = format!(
            "policy: found one of {} observations and {} actions; {agent} has {} and {}",
            found.0, found.1, expected.0, expected.1
        );
        return Err(exception(py, "ConfigError", words));
    }
    let policy = policy.policy.clone();
    let evaluation = attended(py, progress, move || {
        let arena = Arena::new(agent, shift, ScoreTable::default());
        Ok(rolled_out(
            &policy,
            arena,
            episodes,
            Streams::new(seed),
            Actions::mean_if(deterministic),
            tce_base::interrupted,
        )?)
    })?;
    Ok(serde_json::to_string(&evaluation).expect("plain data"))
}
