//! `tce compare`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::mean_and_error;
use tce_learn::{DynamicsConfig, FittedQConfig, FittedValue, Policy};
use tce_nn::Device;
use tce_run::error::{Error, Result};
use tce_run::inputs::Inputs;
use tce_run::off_policy_evaluation::{OffPolicyEstimate, OffPolicyEvaluator};
use tce_run::own::Own;
use tce_zoo::actors::read_policy;

use crate::estimates::{Estimated, estimates};
use crate::output::Output;

/// Arguments of `compare`.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// The policies to compare: files, or zoo:NAME.
    #[arg(required = true, value_name = "POLICY")]
    policies: Vec<PathBuf>,
    /// Many transitions of the unchanged robot.
    #[arg(long, value_name = "FILE")]
    source: Option<PathBuf>,
    /// Few transitions of the changed robot.
    #[arg(long, value_name = "FILE")]
    target: PathBuf,
    /// Updates of the learned dynamics.
    #[arg(long, default_value_t = DynamicsConfig::default().steps, value_name = "STEPS")]
    dynamics_steps: u64,
    /// Updates of fitted Q evaluation, a second opinion on the policies; 0: none.
    #[arg(long, default_value_t = FittedQConfig::default().steps, value_name = "STEPS")]
    fitted_q_steps: u64,
    /// Where the learned dynamics are kept, for a second call.
    #[arg(long, default_value = "runs")]
    cache: PathBuf,
    #[command(flatten)]
    own: Own,
}

#[derive(Serialize)]
struct Report {
    /// Median and 95th percentile of the errors of the learned dynamics on held-out target rows, in steps.
    held_out: [f64; 2],
    /// The discounted return of the target's episodes as they were logged.
    behaviour_value: f64,
    policies: Vec<Line>,
}

#[derive(Serialize)]
struct Line {
    policy: PathBuf,
    #[serde(flatten)]
    estimate: OffPolicyEstimate,
    #[serde(skip_serializing_if = "Option::is_none")]
    fitted_q: Option<FittedValue>,
}

impl CompareArgs {
    /// Runs the command.
    pub fn run(self, output: Output, device: &Device) -> Result<()> {
        let inputs = Inputs::of_files(self.source.as_deref(), &self.target, None, &self.own)?;
        let dims = (inputs.target.rows.obs_dim, inputs.target.rows.act_dim);
        let load = |path: &PathBuf| -> Result<Policy> {
            let policy = read_policy(path)?;
            if policy.dims() != dims {
                return Err(Error::Usage(format!(
                    "{}: found a policy of {:?} observations and actions, expected {dims:?} as in {}; give a policy of this robot",
                    path.display(),
                    policy.dims(),
                    self.target.display()
                )));
            }
            Ok(policy)
        };
        let policies = self.policies.iter().map(load).collect::<Result<Vec<_>>>()?;
        let config = DynamicsConfig { steps: self.dynamics_steps, ..DynamicsConfig::default() };
        let evaluator = OffPolicyEvaluator::train(&inputs, &config, &self.cache, device)?;
        evaluator.doubt().iter().for_each(|doubt| tce_base::note!("warning: {doubt}"));
        let fitted_q = FittedQConfig { steps: self.fitted_q_steps, ..FittedQConfig::default() };
        let values = match fitted_q.steps {
            0 => vec![None; policies.len()],
            _ => evaluator.values(&policies, &fitted_q, device)?.into_iter().map(Some).collect(),
        };
        let lines = self.policies.iter().zip(&policies).zip(values);
        let lines = lines.map(|((path, policy), fitted_q)| {
            Ok(Line { policy: path.clone(), estimate: evaluator.evaluate(policy)?, fitted_q })
        });
        let report = Report {
            held_out: [evaluator.held_out_error(0.5), evaluator.held_out_error(0.95)],
            behaviour_value: evaluator.behaviour_value(&fitted_q),
            policies: lines.collect::<Result<Vec<_>>>()?,
        };
        output.print(&report, render);
        Ok(())
    }
}

fn render(report: &Report) -> String {
    let rows = report.policies.iter().map(|l| {
        let j = &l.estimate;
        Estimated {
            policy: l.policy.display().to_string(),
            imagined_return: j.imagined_return,
            supported_return: j.supported_return,
            standard_error: mean_and_error(&j.supported).1,
            support: Some(j.support),
            fitted_q: l.fitted_q.as_ref().map(|v| [v.mean(), v.standard_error()]),
            action_error: j.action_error,
        }
    });
    let logged = report.policies.iter().any(|l| l.fitted_q.is_some()).then_some(report.behaviour_value);
    format!(
        "learned dynamics, errors on held-out target rows: median {:.3}, 95th percentile {:.3} of a step\n\n{}",
        report.held_out[0],
        report.held_out[1],
        estimates(rows, logged),
    )
}
