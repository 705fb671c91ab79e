//! Models compiled by MuJoCo, once per process.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex, Once, PoisonError};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::prelude::{MjModel, MjtLogLevel};
use mujoco_rs::wrappers::mj_logging::{MjLogMessage, log_config, set_log_config};
use tce_data::{Agent, Shift};

use crate::SimError;

/// Models, indexed by robot and shift.
type Models = HashMap<(Agent, Shift), Arc<MjModel>>;

/// The compiled model of `agent` under `shift`, shared by all environments of the process.
///
/// # Errors
/// If MuJoCo 3.17.0 is not available, or if it rejects the model.
pub fn compiled(agent: Agent, shift: Shift) -> Result<Arc<MjModel>, SimError> {
    static MODELS: LazyLock<Mutex<Models>> = LazyLock::new(Default::default);
    static LOGGING: Once = Once::new();
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(&(agent, shift)) {
        return Ok(model.clone());
    }
    crate::library::open()?;
    LOGGING.call_once(|| {
        // SAFETY: this crate uses MuJoCo only through models returned by this function, so no thread uses it before the
        // first call ends (the lock is held).
        unsafe {
            set_log_handler(report);
            set_log_config(log_config().with_topics(0));
        }
    });
    let model = MjModel::from_xml_string(&super::mjcf(agent, shift)).map_err(|e| SimError::Model {
        agent,
        shift,
        message: format!("{e:?}"),
    })?;
    let model = Arc::new(model);
    models.insert((agent, shift), model.clone());
    Ok(model)
}

/// Replaces MuJoCo's own handler, which would write warnings to `MUJOCO_LOG.TXT` in the current directory. The only
/// possible warning here (an unstable simulation) is reported for each row in [`crate::StepResult::unstable`].
fn report(message: &MjLogMessage) {
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        tce_base::note!("MuJoCo: {}", message.subject());
    }
}
