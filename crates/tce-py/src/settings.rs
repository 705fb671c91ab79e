//! Settings and what is known of a robot, as the package passes them.

use pyo3::prelude::*;
use tce_base::did_you_mean;
use tce_data::parse_environment;
use tce_nn::Device;
use tce_run::config::{Algorithm, Config};
use tce_run::device_kind::DeviceKind;
use tce_run::layers::{ConfigArgs, Preset};
use tce_run::own::{Own, parse_range};
use tce_run::{Error, Result};

/// A preset, a file of changed keys, `KEY=VALUE` in TOML's words, and what computes the networks.
#[derive(FromPyObject)]
pub struct Settings {
    preset: String,
    config: Option<std::path::PathBuf>,
    sets: Vec<String>,
    device: String,
}

/// One of an enumeration of the command line by its name.
pub fn named<T: clap::ValueEnum>(what: &str, name: &str) -> Result<T> {
    T::from_str(name, false).map_err(|_| {
        let all: Vec<String> =
            T::value_variants().iter().filter_map(|v| Some(v.to_possible_value()?.get_name().to_owned())).collect();
        let near = did_you_mean(name, all.iter().map(String::as_str));
        Error::Usage(format!("{what}: found {name:?}, expected one of {}{near}", all.join(", ")))
    })
}

impl Settings {
    fn arguments(&self) -> Result<ConfigArgs> {
        let preset: Preset = named("preset", &self.preset)?;
        Ok(ConfigArgs { preset, config: self.config.clone(), sets: self.sets.clone() })
    }

    /// What computes the networks.
    pub fn device(&self) -> Result<Device> {
        named::<DeviceKind>("device", &self.device)?.device()
    }

    /// The whole configuration.
    pub fn config(&self) -> Result<Config> {
        self.arguments()?.layered(None, None)?.config()
    }

    /// The same for a training by `learner`.
    pub fn for_training(&self, learner: Option<&str>, top: Option<f64>) -> Result<Config> {
        let learner = learner.map(|name| named::<Algorithm>("learner", name)).transpose()?;
        self.arguments()?.with_own_tables(learner, top).layered(None, None)?.config()
    }
}

/// What the user says of the robot.
#[derive(FromPyObject, Default)]
pub struct Robot {
    env: Option<String>,
    step_limit: Option<u32>,
    action_range: Option<String>,
}

impl Robot {
    /// As the command line has it.
    pub fn own(&self) -> Result<Own> {
        let env = self.env.as_deref().map(parse_environment).transpose();
        let range = self.action_range.as_deref().map(parse_range).transpose();
        if self.step_limit == Some(0) {
            return Err(Error::Usage("step_limit: found 0, expected at least 1".to_owned()));
        }
        Ok(Own {
            env: env.map_err(|e| Error::Usage(format!("env: {e}")))?,
            step_limit: self.step_limit,
            action_range: range.map_err(|e| Error::Usage(format!("action_range: {e}")))?,
        })
    }
}
