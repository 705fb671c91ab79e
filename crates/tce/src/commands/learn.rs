//! `tce learn`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use serde::{Deserialize, Serialize};
use tce_base::{plus_minus, read_if_there, sha256_hex};
use tce_data::ScoreTable;
use tce_learn::{About, OtherRows};
use tce_nn::Device;
use tce_run::config::{Algorithm, Config, LearnerConfig};
use tce_run::course::{Course, learning};
use tce_run::error::{Error, Result};
use tce_run::inputs::{Inputs, Table};
use tce_run::judge::Judge;
use tce_run::layers::ConfigArgs;
use tce_run::learning::{Learned, MemberData, learn, save_policies};
use tce_run::methods::row_scores;
use tce_run::own::Own;
use tce_run::pipeline::seeds;
use tce_run::processor::Processor;
use tce_run::verdict::{Candidate, Kept, keep, only, recommend};
use tce_zoo::actors::Arena;

use crate::output::{Output, list as listed, table};

/// Arguments of `learn`.
#[derive(Debug, Args)]
pub struct Learn {
    /// Print all learners: what they are, whose, and how their public code differs.
    #[arg(long)]
    list: bool,
    /// The rows to learn from (HDF5). With --extra, half of every batch comes from here.
    #[arg(long, value_name = "FILE", required_unless_present = "list")]
    target: Option<PathBuf>,
    /// Further rows: the source's, generated ones, or a mixture of both.
    #[arg(long, value_name = "FILE")]
    extra: Option<PathBuf>,
    /// The learner (default: the configuration's).
    #[arg(long, value_enum, alias = "algorithm", help_heading = "What is learned")]
    learner: Option<Algorithm>,
    /// bc: clone the best trajectories only, this share of them.
    #[arg(long, value_name = "SHARE", help_heading = "What is learned")]
    top: Option<f64>,
    /// Policies to learn; all of them are one training.
    #[arg(long, default_value_t = 1, help_heading = "What is learned")]
    seeds: usize,
    /// The first seed.
    #[arg(long, default_value_t = 0, help_heading = "What is learned")]
    seed: u64,
    /// The source's rows, to try the policies in learned dynamics of both robots. Without them the target's rows alone are known.
    #[arg(long, value_name = "FILE", help_heading = "Verdict")]
    source: Option<PathBuf>,
    /// Do not learn a floor from the target rows alone, do not try the policies, and recommend none.
    #[arg(long, help_heading = "Verdict")]
    no_verdict: bool,
    /// Directory for policies and metrics.
    #[arg(long, required_unless_present = "list")]
    out: Option<PathBuf>,
    #[command(flatten)]
    own: Own,
    #[command(flatten)]
    config: ConfigArgs,
}

/// What stands beside a policy that more than the target rows were used for.
const FLOOR: &str = "cloning the target rows";

#[derive(Serialize, Deserialize)]
struct Report {
    policies: Vec<PathBuf>,
    seeds: Vec<u64>,
    #[serde(flatten)]
    learned: Learned,
    /// The recommendation, and the file `policy.safetensors` with the policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    verdict: Option<Kept>,
}

impl Learn {
    /// Runs the command.
    pub fn run(mut self, output: Output, device: &Device) -> Result<()> {
        // clap asks for the files unless the list is wanted.
        let (Some(target_file), Some(out)) = (self.target.take(), self.out.take()) else {
            let all: Vec<About> = Algorithm::ALL.iter().map(|a| a.about()).collect();
            output.print(&all, |all| list(all));
            return Ok(());
        };
        self.config = self.config.with_learner(self.learner);
        self.config.sets.extend(self.top.map(|top| format!("learner.top={top:?}")));
        if self.learner.is_some_and(|learner| learner.about().needs == OtherRows::Scored) {
            // The rows are in the files here; without scores of their own they are scored as source rows are.
            self.config.sets.splice(0..0, ["mixture.generated=none".to_owned(), "mixture.source=all".to_owned()]);
        }
        let config = self.config.layered(None, None)?.config()?;
        let seeds = seeds(self.seed, self.seeds)?;
        let method = config.learner.algorithm.about();
        self.refuse_what_does_not_fit(&config)?;
        super::refuse::folder(&out)?;
        // Everything is read before anything is computed: a file that does not fit is no surprise after hours.
        let source = self.source.as_deref().filter(|_| !self.no_verdict);
        let inputs = Inputs::of_files(source, &target_file, self.extra.as_deref(), &self.own)?;
        let inputs = inputs.with_target_rows(config.target.rows);
        inputs.ensure_episodes(&config.learner)?;
        let complete = !config.learner.algorithm.about().successors;
        let rows = |table: &Table| Arc::new(if complete { table.complete() } else { &table.rows }.clone());
        let (target, extra) = (rows(&inputs.target), inputs.extra.as_ref().map(rows));
        let arena = self.own.env.map(|(agent, shift)| Arena::new(agent, shift, ScoreTable::default()));
        let spec = self.spec(&config, &seeds, &inputs, device);
        let key = sha256_hex(spec.to_string().as_bytes());
        let place = (out.as_path(), key.as_str());
        if let Some(report) = found(&out, &spec)? {
            tce_base::note!("done before, in {}", out.display());
            output.print(&report, render);
            return Ok(());
        }
        let row_scores = match &extra {
            Some(extra) => row_scores(&config, &target, extra)?,
            None => None,
        };
        let member = |&seed: &u64| MemberData {
            seed,
            target: target.clone(),
            extra: extra.clone(),
            row_scores: row_scores.clone(),
            trajectories: vec![target.clone()],
        };
        let data: Vec<_> = seeds.iter().map(member).collect();
        let alone = data.iter().map(|d| MemberData { extra: None, row_scores: None, ..d.clone() }).collect();
        tce_base::write_json(&out.join("spec.json"), &spec)?;
        tce_base::write_atomically(&out.join("config.toml"), config.to_toml().as_bytes())?;
        self.plan(&config, &inputs, seeds.len(), &out, device);
        tce_base::begin_step(&learning(method.name));
        let mut files = Vec::new();
        let learned = learn(data, &config.learner, &config.evaluation, arena, place, device, |policies| {
            files = save_policies(policies, &seeds, &out, &inputs)?;
            Ok(())
        })?;
        let verdict = match self.no_verdict {
            true => None,
            false => {
                let own = Candidate { name: method.name.into(), floor: extra.is_none(), files: files.clone() };
                let place = (out.as_path(), key.as_str());
                let floor =
                    extra.is_some().then(|| floor(alone, &config, &seeds, place, &inputs, device)).transpose()?;
                let judge = || Judge::train(&inputs, &config.dynamics, &out, device);
                let candidates: Vec<_> = floor.into_iter().chain([own]).collect();
                // Without a simulator a single policy is tried, too: nothing else tells what it is worth.
                let alone = self.own.env.and_then(|_| only(&candidates));
                let fitted_q = (config.fitted_q.steps > 0).then_some((&config.fitted_q, device));
                let verdict = alone.map_or_else(|| recommend(judge, &candidates, fitted_q), Ok)?;
                Some(keep(verdict, &out)?)
            }
        };
        let report = Report { policies: files, seeds, learned, verdict };
        tce_base::write_json(&out.join("summary.json"), &report)?;
        output.print(&report, render);
        Ok(())
    }
}

impl Learn {
    /// Refuses options and files that the learner has no use for, or that it lacks.
    fn refuse_what_does_not_fit(&self, config: &Config) -> Result<()> {
        let method = config.learner.algorithm.about();
        if self.top.is_some() && config.learner.algorithm != Algorithm::Bc {
            return Err(Error::Usage(format!(
                "--top: found --learner {}, expected bc, whose option it is",
                method.name
            )));
        }
        if self.extra.is_none() && method.needs == OtherRows::Source {
            return Err(Error::Usage(format!(
                "--learner {}: found target rows alone, expected source rows as well; give them with --extra FILE",
                method.name
            )));
        }
        Ok(())
    }

    /// What decides the result.
    fn spec(&self, config: &Config, seeds: &[u64], inputs: &Inputs, device: &Device) -> serde_json::Value {
        let mut spec = serde_json::json!({
            "program": env!("CARGO_PKG_VERSION"), "config": config, "seeds": seeds, "own": &self.own, "actions": &inputs.actions,
            "target": &inputs.target.hash, "extra": inputs.extra.as_ref().map(|t| &t.hash),
        });
        if let Some(source) = &inputs.source {
            spec["source"] = source.hash.clone().into();
        }
        Processor::from(device).sign(&mut spec);
        spec
    }

    /// Tells the steps that are to come.
    fn plan(&self, config: &Config, inputs: &Inputs, seeds: usize, out: &Path, device: &Device) {
        let rows = &inputs.target.rows;
        let mut course = Course::new(format!("{}x{}", rows.obs_dim, rows.act_dim), seeds, device, out);
        let mixed = inputs.extra.is_some();
        course.learning(config.learner.algorithm.about().name, config, mixed);
        if !self.no_verdict {
            if mixed {
                course.learning(FLOOR, &Config { learner: floor_learner(config), ..config.clone() }, false);
            }
            course.verdict(config);
            course.fitted_q(config, seeds * if mixed { 2 } else { 1 });
        }
        course.plan();
    }
}

/// What the target rows alone are good for: an ensemble of clones per seed, in `floor/`.
fn floor(
    data: Vec<MemberData>,
    config: &Config,
    seeds: &[u64],
    (out, key): (&Path, &str),
    inputs: &Inputs,
    device: &Device,
) -> Result<Candidate> {
    let learner = floor_learner(config);
    let directory = out.join("floor");
    tce_base::begin_step(&learning(FLOOR));
    let mut files = Vec::new();
    learn(data, &learner, &config.evaluation, None, (&directory, key), device, |policies| {
        files = save_policies(policies, seeds, &directory, inputs)?;
        Ok(())
    })?;
    Ok(Candidate { name: FLOOR.into(), floor: true, files })
}

/// The learner of the floor.
fn floor_learner(config: &Config) -> LearnerConfig {
    LearnerConfig { algorithm: Algorithm::Bc, standardise: true, top: 1.0, ..config.learner.clone() }
}

/// What a learning of `spec` left in `out`, if it came to its end; None where it is to begin or to go on.
///
/// # Errors
/// If another learning's results, or what it left when it was interrupted, are there.
fn found(out: &Path, spec: &serde_json::Value) -> Result<Option<Report>> {
    let (spec_file, summary_file) = (out.join("spec.json"), out.join("summary.json"));
    let summary = read_if_there(&summary_file)?;
    let same = match read_if_there(&spec_file)? {
        Some(bytes) => serde_json::from_slice::<serde_json::Value>(&bytes).is_ok_and(|found| found == *spec),
        None => summary.is_none(),
    };
    if !same {
        let end = if summary.is_some() { "the results of" } else { "an interrupted" };
        return Err(Error::Usage(format!(
            "{}: found {end} learning with other settings, seeds or files; choose another --out{}",
            out.display(),
            if summary.is_some() { " (tce evaluate judges a policy that is there)" } else { ", or remove it" }
        )));
    }
    let Some(bytes) = summary else { return Ok(None) };
    let report = serde_json::from_slice::<Report>(&bytes);
    match report.map(|r| (r.policies.iter().all(|p| p.exists()), r)) {
        Ok((true, report)) => Ok(Some(report)),
        // Its policies were removed or moved: they are learned again.
        _ => Ok(None),
    }
}

fn render(report: &Report) -> String {
    let mut text = String::new();
    // Without a simulator there are no returns, and a table of dashes says nothing.
    if report.learned.evaluations.iter().any(|e| e.failed.is_none()) {
        let rows = report.policies.iter().enumerate().map(|(m, path)| {
            let evaluation = report.learned.evaluations.get(m);
            [
                path.display().to_string(),
                evaluation.filter(|e| e.failed.is_none()).map_or("-".into(), |e| plus_minus(&e.returns)),
                evaluation.and_then(|e| e.score).map_or("-".into(), |s| format!("{s:.1}")),
            ]
        });
        text += &table(&["policy", "return", "score"], rows);
    } else {
        text.extend(report.policies.iter().map(|p| format!("{}\n", p.display())));
    }
    for (m, seed) in report.seeds.iter().enumerate() {
        let broken = report.learned.figures.iter().filter(|(_, values)| values.get(m).is_some_and(Option::is_none));
        let names: Vec<_> = broken.map(|(name, _)| name.as_str()).collect();
        if !names.is_empty() {
            text += &format!("\nDIVERGED: seed {seed}: {} not finite at the end", names.join(", "));
        }
    }
    if let Some(kept) = &report.verdict {
        let rows = kept.verdict.tried.iter().map(|t| {
            [
                if t.floor { format!("{} (baseline)", t.name) } else { t.name.clone() },
                format!("{:.1} ± {:.1}", t.imagined_return, t.standard_error),
                format!("{:.0} %", 100.0 * t.survival),
                t.fitted_q.map_or("-".into(), |[value, error]| format!("{value:.1} ± {error:.1}")),
                format!("{:.3}", t.action_error),
            ]
        });
        let logged = kept.verdict.behaviour_value.map(|value| {
            let name = "the target's logged episodes".to_owned();
            [name, "-".into(), "-".into(), format!("{value:.1}"), "0".into()]
        });
        let header = ["policy", "imagined return", "of an episode survived", "fitted Q", "action error"];
        text += &format!(
            "\nEstimated without a simulator (± standard error):\n{}\n\
             imagined return: of episodes in learned dynamics of the robot\n\
             fitted Q: return with each later reward worth 1 % less, by fitted Q evaluation on the target's rows\n\
             action error: RMSE against the target rows' own actions, in a range of 2; it tells how closely they are cloned\n\n{}",
            table(&header, rows.chain(logged)),
            kept.sentences()
        );
    }
    text
}

fn list(methods: &[About]) -> String {
    let rows = methods.iter().map(|m| {
        let modes = m.published.map_or_else(String::new, |what| format!("published: {what}"));
        [m.name, m.description, m.reference, &m.needs.to_string(), &modes].map(str::to_owned)
    });
    let text =
        listed(&["learner", "what it is", "reference", "besides target rows", "mode (default: corrected)"], rows);
    format!(
        "{text}\nSettings: learner.NAME, with _ for - (tce config show); a mode is chosen by --set learner.dara.mode=published"
    )
}
