//! The networks that a training run starts from, if they are not new.

use std::path::Path;

use tce_base::sha256_file;
use tce_data::Agent;
use tce_learn::sac::Sac;
use tce_learn::{Learner, PolicyKind};
use tce_nn::NamedParameters;

use super::ledger::{Ledger, verify};
use super::settings::{Origin, Settings};
use crate::actors::load_policy;
use crate::error::{Error, Result};
use crate::exhibits::Exhibit;

impl Origin {
    /// The origin for a training run's directory, a policy file or `zoo:NAME`.
    pub(super) fn of(path: &Path, agent: Agent) -> Result<Self> {
        if let Some(exhibit) = Exhibit::at(path)? {
            return Ok(Self::Actor { actor: path.to_owned(), sha256: exhibit.sha256() });
        }
        if path.is_file() {
            return Ok(Self::Actor { actor: path.to_owned(), sha256: sha256_file(path)? });
        }
        let none = || {
            let message = "no checkpoint of a training here; give the directory of one, such as \
                runs/sac/hopper-source-seed0, or a policy: its file, or zoo:NAME";
            Error::Usage(format!("{}: {message}", path.display()))
        };
        let settings = Settings::read(path)?.ok_or_else(none)?;
        if settings.agent != agent {
            let message = "a policy of one robot cannot drive another";
            return Err(Error::Usage(format!("{}: a training of {}; {message}", path.display(), settings.agent)));
        }
        let ledger = Ledger::read(path)?.ok_or_else(none)?;
        let (file, sha256) = ledger.files.into_iter().find(|f| f.0.ends_with(".safetensors")).ok_or_else(none)?;
        let training = format!("{agent}-{} seed {}, step {}", settings.shift, settings.seed, ledger.step);
        Ok(Self::Training { directory: path.to_owned(), training, file, sha256 })
    }

    /// Copies the networks into a training run that starts.
    pub(super) fn start(&self, sac: &mut Sac, agent: Agent) -> Result<()> {
        match self {
            Self::Training { directory, file, sha256, .. } => {
                let path = directory.join(file);
                verify(&path, sha256)?;
                sac.restore(&NamedParameters::load(&path)?, &path)?;
            }
            Self::Actor { actor, .. } => {
                let policy = load_policy(actor, agent)?;
                let PolicyKind::Mlp(network) = policy.kind() else {
                    let message = "a policy with a memory; SAC goes on from networks of one state only";
                    return Err(Error::Usage(format!("{}: {message}", actor.display())));
                };
                sac.begin_with(network, actor)?;
            }
        }
        Ok(())
    }
}
