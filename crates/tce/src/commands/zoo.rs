//! `tce zoo list`, `show`, `rollout` and `keep`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_base::{Streams, counted, interrupted, mean_std, write_atomically};
use tce_data::{Agent, ScoreTable, Shift, parse_environment};
use tce_learn::Policy;
use tce_nn::NamedParameters;
use tce_run::error::{Error, Result};
use tce_zoo::actors::{Actions, Arena, Evaluation, evaluate};
use tce_zoo::exhibits::{Card, Exhibit};

use crate::output::{Output, table};

/// The commands of `zoo`. To collect rows: `tce collect --env hopper --actor zoo:hopper-source-medium`.
#[derive(Debug, Subcommand)]
pub enum Zoo {
    /// All actors, with what they return.
    List,
    /// Everything about one actor.
    Show(Show),
    /// Roll actors out in their own domain, beside what their cards say.
    Rollout(Rollout),
    /// Make a trained policy an actor of the zoo: half precision, and a card from new episodes.
    Keep(Keep),
}

/// Arguments of `zoo show`.
#[derive(Debug, Args)]
pub struct Show {
    /// The actor: hopper-source-medium.
    name: String,
}

/// Arguments of `zoo rollout`.
#[derive(Debug, Args)]
pub struct Rollout {
    /// Actors (default: all).
    names: Vec<String>,
    /// Episodes, with sampled actions.
    #[arg(long, default_value_t = 20)]
    episodes: usize,
    /// Take the mean action instead.
    #[arg(long)]
    mean: bool,
    /// Seed of resets and actions.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Arguments of `zoo keep`.
#[derive(Debug, Args)]
pub struct Keep {
    /// A policy written by `tce train-sac`; or a clone made by `tce learn`, with the next three options.
    policy: PathBuf,
    /// The domain of a clone, whose file does not name it: hopper-kinematic.
    #[arg(long, value_parser = parse_environment, requires = "cloned_from")]
    env: Option<(Agent, Shift)>,
    /// The rows whose behaviour was cloned, in words for the card.
    #[arg(long, requires_all = ["env", "updates"])]
    cloned_from: Option<String>,
    /// Updates of a clone.
    #[arg(long, requires = "cloned_from")]
    updates: Option<u64>,
    /// Rows per update of a clone.
    #[arg(long, default_value_t = 256, requires = "cloned_from")]
    batch: usize,
    /// Seed of a clone.
    #[arg(long, default_value_t = 0, requires = "cloned_from")]
    seed: u64,
    /// What it is kept for: medium, expert, or stage-N.
    #[arg(long)]
    role: String,
    /// Episodes behind the card's figures. They are others than those for which the policy was chosen.
    #[arg(long, default_value_t = 100)]
    episodes: usize,
    /// The folder of the zoo.
    #[arg(long, default_value = "crates/tce-zoo/zoo")]
    out: PathBuf,
    /// Replace an actor that is there.
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Shown {
    name: String,
    bytes: usize,
    sha256: String,
    #[serde(flatten)]
    card: Card,
}

#[derive(Serialize)]
struct Rolled {
    name: String,
    card: Card,
    #[serde(flatten)]
    evaluation: Evaluation,
}

impl Shown {
    fn of(exhibit: &Exhibit) -> Result<Self> {
        let (name, sha256) = (exhibit.name.to_owned(), exhibit.sha256());
        Ok(Self { name, bytes: exhibit.size(), sha256, card: exhibit.card()? })
    }

    fn score(&self) -> String {
        self.card.score.map_or("-".into(), |s| format!("{s:.1}"))
    }
}

impl Zoo {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        match self {
            Zoo::List => {
                let all = Exhibit::all().iter().map(Shown::of).collect::<Result<Vec<_>>>()?;
                output.print(&all, |all| list(all));
            }
            Zoo::Show(args) => {
                let shown = Shown::of(&Exhibit::find(&args.name)?)?;
                output.print(&shown, show);
            }
            Zoo::Rollout(args) => args.run(output)?,
            Zoo::Keep(args) => args.run(output)?,
        }
        Ok(())
    }
}

fn list(all: &[Shown]) -> String {
    let rows = all.iter().map(|s| {
        let c = &s.card;
        [
            s.name.clone(),
            format!("{:.0} ± {:.0}", c.mean, c.std),
            format!("{:.0}", c.length),
            s.score(),
            c.updates.to_string(),
            c.seed.to_string(),
            format!("{:.0} kB", s.bytes as f64 / 1e3),
        ]
    });
    table(&["actor", "return", "length", "score", "updates", "seed", "size"], rows)
}

fn show(s: &Shown) -> String {
    let c = &s.card;
    let began = c.from.clone().unwrap_or_else(|| "new networks".into());
    let episodes = counted(c.episodes, "episode", "episodes");
    let rows = [
        ("robot", format!("{}, {}", c.agent, c.shift)),
        ("role", c.role.clone().unwrap_or_default()),
        ("return", format!("{:.1} ± {:.1} over {episodes} with sampled actions", c.mean, c.std)),
        ("length", format!("{:.1}", c.length)),
        ("score", s.score()),
        ("training", training(c)),
        ("began with", began),
        ("trained by", c.program.clone()),
        ("file", format!("{} bytes", s.bytes)),
        ("SHA-256", s.sha256.clone()),
        ("use it as", format!("zoo:{}", s.name)),
    ];
    rows.iter().fold(format!("{}\n", s.name), |text, (name, value)| text + &format!("  {name:<12} {value}\n"))
}

fn training(c: &Card) -> String {
    let Card { seed, steps, updates, batch, .. } = c;
    match &c.cloned_from {
        None => format!("SAC, seed {seed}, {steps} steps, {updates} updates of {batch} rows"),
        Some(rows) => format!("behaviour cloning of {rows}, seed {seed}, {updates} updates of {batch} rows"),
    }
}

impl Rollout {
    fn run(self, output: Output) -> Result<()> {
        if self.episodes == 0 {
            return Err(Error::Usage("--episodes must be at least 1".into()));
        }
        tce_sim::open_library()?;
        let exhibits = if self.names.is_empty() {
            Exhibit::all()
        } else {
            self.names.iter().map(|n| Exhibit::find(n)).collect::<tce_zoo::Result<_>>()?
        };
        let actions = Actions::mean_if(self.mean);
        let mut all = Vec::new();
        for exhibit in exhibits {
            let card = exhibit.card()?;
            let evaluation = evaluate_card(&exhibit.policy()?, &card, self.episodes, Streams::new(self.seed), actions)?;
            all.push(Rolled { name: exhibit.name.to_owned(), card, evaluation });
        }
        output.print(&all, |all| {
            let rows = all.iter().map(|r| {
                let (mean, std) = mean_std(&r.evaluation.returns);
                [
                    r.name.clone(),
                    r.evaluation.returns.len().to_string(),
                    format!("{mean:.0} ± {std:.0}"),
                    format!("{:.0}", r.evaluation.mean_length()),
                    r.evaluation.score.map_or("-".into(), |s| format!("{s:.1}")),
                    format!("{:.0} ± {:.0}", r.card.mean, r.card.std),
                ]
            });
            table(&["actor", "episodes", "return", "length", "score", "its card says"], rows)
        });
        Ok(())
    }
}

fn evaluate_card(
    policy: &Policy,
    card: &Card,
    episodes: usize,
    streams: Streams,
    actions: Actions,
) -> Result<Evaluation> {
    let arena = Arena::new(card.agent, card.shift, ScoreTable::default());
    Ok(evaluate(policy, arena, episodes, streams, actions, interrupted)?)
}

impl Keep {
    /// What is known of the policy before it is evaluated.
    fn card(&self, parameters: &NamedParameters) -> Result<Card> {
        let written = Card::of(parameters, &self.policy)?;
        let (Some((agent, shift)), Some(rows)) = (self.env, &self.cloned_from) else {
            return written.ok_or_else(|| {
                let path = self.policy.display();
                Error::Usage(format!(
                    "{path}: has no card; give a policy written by `tce train-sac`, or say what it is with --env, \
                     --cloned-from and --updates"
                ))
            });
        };
        if written.is_some() {
            let path = self.policy.display();
            return Err(Error::Usage(format!("{path}: has a card of its own; leave out --env and --cloned-from")));
        }
        let updates = self.updates.unwrap_or_default();
        Ok(Card::of_clone(agent, shift, rows.clone(), self.seed, updates, self.batch))
    }

    fn run(self, output: Output) -> Result<()> {
        let stage = self.role.strip_prefix("stage-").is_some_and(|n| n.parse::<u32>().is_ok());
        if !(stage || self.role == "medium" || self.role == "expert") {
            return Err(Error::Usage(format!("--role {}: expected medium, expert or stage-N", self.role)));
        }
        if self.episodes < 20 {
            return Err(Error::Usage("--episodes: a card needs at least 20".into()));
        }
        tce_sim::open_library()?;
        let full = NamedParameters::load(&self.policy)?;
        let card = self.card(&full)?;
        // What is evaluated is what will be read back.
        let mut parameters = full.to_half();
        let policy = Policy::from_parameters(&parameters, &self.policy)?;
        let streams = Streams::new(card.seed ^ u64::MAX);
        let evaluation = evaluate_card(&policy, &card, self.episodes, streams, Actions::Sampled)?;
        let (mean, std) = mean_std(&evaluation.returns);
        let (length, score, episodes) = (evaluation.mean_length(), evaluation.score, self.episodes);
        let card = Card { role: Some(self.role), episodes, mean, std, length, score, ..card };
        card.attach(&mut parameters);
        let name = card.name().expect("it has a role");
        let path = self.out.join(format!("{name}.safetensors"));
        super::refuse::existing(&path, self.force)?;
        let bytes = parameters.to_half_bytes();
        write_atomically(&path, &bytes)?;
        let shown = Shown { name, bytes: bytes.len(), sha256: tce_base::sha256_hex(&bytes), card };
        output.print(&shown, show);
        Ok(())
    }
}
