//! The two data sets of a run: found, loaded, and refused together if they do not fit.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;
use tce_base::counted;
use tce_data::{
    ActionRange, Agent, Choice, ReferenceScores, ScoreTable, Shift, Task, Transitions, choose_trajectories,
    ensure_same_agent, infer_agents, reference_scores,
};
use tce_sim::EPISODE_LIMIT;

use crate::config::{Config, LearnerConfig, TargetConfig, Trajectories};
use crate::error::{Error, Result};
use crate::own::{Own, range_of};
pub use crate::tables::{Behaviour, Table};
pub use crate::task_data::{Actors, DataArgs, d4rl_recipe, ensure_data, source_file, target_file};

/// Source and target, and what is known about where they come from.
#[derive(Clone, Debug)]
pub struct Inputs {
    /// The robot, where it is one of the benchmark's.
    pub agent: Option<Agent>,
    /// The target's shift, where the simulator can be used for it.
    pub shift: Option<Shift>,
    /// Target rows.
    pub target: Table,
    /// Source rows; variants that do not look at them can do without.
    pub source: Option<Table>,
    /// Rows of a third file, to learn from.
    pub extra: Option<Table>,
    /// The units of the files' actions, where they are not the box [-1, 1]. The tables are in the box.
    pub actions: Option<ActionRange>,
    /// The collector's step limit, where the user gave one.
    limit: Option<usize>,
}

/// Which data a stage looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Domains {
    /// The target's alone.
    Target,
    /// Those of both domains, where there is a source.
    Both,
}

impl Domains {
    /// Both, if the source is needed.
    pub fn with_source(needed: bool) -> Self {
        if needed { Self::Both } else { Self::Target }
    }
}

/// What identifies the inputs in a specification.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InputSpec {
    agent: Option<Agent>,
    shift: Option<Shift>,
    target: String,
    source: Option<String>,
    /// The rows that are imitated, where they are not all.
    #[serde(skip_serializing_if = "Option::is_none")]
    chosen: Option<String>,
    /// The units of actions; they depend on all files.
    #[serde(skip_serializing_if = "Option::is_none")]
    actions: Option<ActionRange>,
    #[serde(skip_serializing_if = "Option::is_none")]
    step_limit: Option<usize>,
}

/// The first `rows` rows, the last of which ends its episode; None where those are all (0 means all of them, too).
pub(crate) fn first_rows(t: &Transitions, rows: usize) -> Option<Transitions> {
    (rows > 0 && rows < t.len()).then(|| {
        let mut first = t.select(&(0..rows).collect::<Vec<_>>());
        first.timeouts[rows - 1] = !first.terminals[rows - 1];
        first
    })
}

impl Inputs {
    /// A user's own files: of a robot of which only that is known that the user says.
    pub fn of_files(source: Option<&Path>, target: &Path, extra: Option<&Path>, own: &Own) -> Result<Self> {
        let options = own.load_options();
        let table = |path: &Path| Table::read(path, &options);
        let (target, source) = (table(target)?, source.map(table).transpose()?);
        let extra = extra.map(|path| Table::besides(path, &options, &target)).transpose()?;
        let (agent, limit) = (own.agent(), own.step_limit.map(|n| n as usize));
        Self { agent, shift: None, target, source, extra, actions: None, limit }.checked(own)
    }

    /// The same with rows in memory, which were checked when they were read ([`tce_data::load`], [`tce_data::from_columns`]). A number of
    /// `origin` per row of `extra` tells which of them are target rows (0), as in a file of `tce augment`.
    pub fn of_rows(
        source: Option<Arc<Transitions>>,
        target: Arc<Transitions>,
        extra: Option<(Arc<Transitions>, Option<&[f32]>)>,
        own: &Own,
    ) -> Result<Self> {
        let (target, source) =
            (Table::in_memory(target, "target"), source.map(|rows| Table::in_memory(rows, "source")));
        let besides = |(rows, origin): (Arc<Transitions>, Option<&[f32]>)| {
            let Table { rows, hash, complete, .. } = Table::in_memory(rows, "extra");
            Table::without_target(complete.unwrap_or(rows), origin, Path::new("extra"), hash, &target)
        };
        let extra = extra.map(besides).transpose()?;
        let (agent, limit) = (own.agent(), own.step_limit.map(|n| n as usize));
        Self { agent, shift: None, target, source, extra, actions: None, limit }.checked(own)
    }

    /// Finds the units of the files' actions, and brings all tables into the box.
    fn bring_into_the_box(&mut self, own: &Own) -> Result<()> {
        let tables = [Some(&self.target), self.source.as_ref(), self.extra.as_ref()];
        let rows: Vec<&Transitions> = tables.into_iter().flatten().map(Table::complete).collect();
        let found = ActionRange::of(&rows);
        if let Some(found) = found.as_ref().filter(|r| !r.fits(rows[0].act_dim)) {
            return Err(Error::Failed(format!(
                "{}: found actions of {found}, expected a range that float32 can hold; scale them",
                self.target.file.display()
            )));
        }
        let wild = if own.action_range.is_none() { ActionRange::with_outliers(&rows) } else { Vec::new() };
        if !wild.is_empty() {
            tce_base::note!(
                "warning: action columns {wild:?} have values more than ten times what 99.9 % of them are: all others become small inside. Remove \
                 them, or give --action-range"
            );
        }
        let range = match (&own.action_range, self.agent) {
            (Some(given), _) => {
                let range = range_of(given, rows[0].act_dim, &self.target.file).map_err(Error::Usage)?;
                let outside: usize = rows.iter().map(|t| range.outside(&t.actions)).sum();
                if outside > 0 {
                    let outside = counted(outside, "action value lies", "action values lie");
                    tce_base::note!("warning: {outside} outside of --action-range {range}");
                }
                Some(range)
            }
            // The benchmark's robots take actions in the box, and clamp others.
            (None, Some(agent)) => {
                if let Some(found) = &found {
                    tce_base::note!("warning: actions range over {found}; {agent} clamps them to [-1, 1]");
                }
                None
            }
            (None, None) => {
                if let Some(found) = &found {
                    tce_base::note!(
                        "actions range over {found}: scaled to [-1, 1] inside; generated rows and policies are in these units \
                         (--action-range sets others)"
                    );
                }
                found
            }
        };
        self.actions = range.filter(|r| !r.is_unit());
        if let Some(range) = &self.actions {
            // The target's alone are written again.
            self.target.own_actions = Some(self.target.complete().actions.clone());
            let (target, source, extra) = (&mut self.target, &mut self.source, &mut self.extra);
            std::iter::once(target).chain(source).chain(extra).for_each(|table| table.scale(range));
        }
        Ok(())
    }

    /// All target rows as the file has them.
    pub fn target_in_own_units(&self) -> Transitions {
        let mut rows = self.target.complete().clone();
        if let Some(own) = &self.target.own_actions {
            rows.actions.clone_from(own);
        }
        rows
    }

    /// `rows` of the program in the units of the files.
    pub fn in_own_units(&self, rows: &Transitions) -> Transitions {
        let mut rows = rows.clone();
        self.actions.iter().for_each(|range| range.to_own(&mut rows.actions));
        rows
    }

    /// The data of a benchmark task: files where given; otherwise OTDF's public target file if the shared folder has it, and
    /// what the zoo's actors (or those of the shared folder) collect: 5000 target rows, and source rows by D4RL's recipe of
    /// which `source_rows` is the size of a medium set. Collected rows are kept beside the results. Without `source_rows` no
    /// source is looked at.
    pub fn of_task(task: Task, args: &DataArgs, source_rows: Option<usize>) -> Result<Self> {
        let Task { agent, shift, .. } = task;
        let own = Own { env: Some((agent, shift)), ..Own::default() };
        let options = own.load_options();
        let target = Table::read(&target_file(task, args)?, &options)?;
        let source = source_rows.map(|rows| Table::read(&source_file(task, args, rows)?, &options)).transpose()?;
        let (agent, shift) = (Some(agent), Some(shift));
        Self { agent, shift, target, source, extra: None, actions: None, limit: None }.checked(&own)
    }

    /// [`Inputs::of_task`] as `config` wants them: without source rows if it has no use for them, with as many target rows as it says.
    pub fn of_config(task: Task, args: &DataArgs, config: &Config) -> Result<Self> {
        let rows = config.needs_source().then_some(config.source.rows);
        Self::of_task(task, args, rows)?.with_target_rows(config.target.rows)
    }

    /// What `config` looks at: without the source if it has no use for one. What is not in a cache key must not decide anything: one call's
    /// inputs serve several configurations.
    pub fn seen_by(&self, config: &Config) -> Cow<'_, Self> {
        match config.needs_source() || self.source.is_none() {
            true => Cow::Borrowed(self),
            false => Cow::Owned(Self { source: None, ..self.clone() }),
        }
    }

    /// The same with other target rows, of which `hash` tells what they are.
    pub fn with_target(mut self, rows: Transitions, hash: String) -> Self {
        // The first rows, in all places where actions in own units are asked for later.
        let own_actions = self.target.own_actions.take().map(|mut own| {
            own.truncate(rows.actions.len());
            own
        });
        self.target = Table { own_actions, ..Table::new(rows, &self.target.file, hash) };
        self
    }

    /// The first `rows` target rows alone, as if the log had ended there; 0, or more than there are, means all of them.
    ///
    /// # Errors
    /// If nothing can be learned of so few.
    pub fn with_target_rows(self, rows: usize) -> Result<Self> {
        let Some(first) = first_rows(self.target.complete(), rows) else { return Ok(self) };
        let hash = format!("{}, the first {rows} rows", self.target.hash);
        let inputs = self.with_target(first, hash);
        inputs.target.usable().map_err(|error| Error::Usage(format!("target.rows = {rows}: {error}")))?;
        Ok(inputs)
    }

    /// The trajectories to imitate, where `config` wants the better ones and the returns show two behaviours; None: all of them.
    pub fn choice(&self, config: &TargetConfig) -> Option<Choice> {
        let wanted = config.trajectories == Trajectories::Auto && self.target.has_episodes();
        wanted.then(|| choose_trajectories(self.target.complete())).filter(Choice::is_selective)
    }

    /// Refuses target rows in no order for a learner that follows episodes.
    ///
    /// # Errors
    /// Names the setting.
    pub fn ensure_episodes(&self, learner: &LearnerConfig) -> Result<()> {
        let needs = match learner.algorithm {
            algorithm if algorithm.about().episodes => format!("{} learns sequences", algorithm.about().name),
            _ if learner.top < 1.0 => "learner.top chooses by the returns of episodes".to_owned(),
            _ => return Ok(()),
        };
        match self.target.has_episodes() {
            true => Ok(()),
            false => Err(Error::Failed(format!(
                "{}: found rows in no order ({} episodes in {} rows), expected episodes: {needs}; record them in order, or choose another learner",
                self.target.file.display(),
                self.target.complete().episodes().len(),
                self.target.complete().len()
            ))),
        }
    }

    /// The better trajectories of the target, where not all of its rows are imitated.
    fn chosen(&self, config: &TargetConfig) -> Option<Transitions> {
        self.choice(config).map(|choice| self.target.complete().select(&choice.rows))
    }

    /// The target rows that learners imitate. What only has to know the dynamics (label models, learned dynamics) takes all rows.
    pub fn learned_from(&self, config: &TargetConfig) -> Arc<Transitions> {
        self.chosen(config).map_or_else(|| self.target.all_rows(), Arc::new)
    }

    /// Those of [`Self::learned_from`] whose successor is known, which the generator imitates.
    pub fn imitated(&self, config: &TargetConfig) -> Cow<'_, Transitions> {
        match self.chosen(config) {
            Some(rows) => Cow::Owned(rows.with_successors().into_owned()),
            None => Cow::Borrowed(&self.target.rows),
        }
    }

    /// [`Inputs::spec`] of work that sees the imitated rows alone.
    pub fn spec_imitated(&self, domains: Domains, config: &TargetConfig) -> InputSpec {
        let chosen = self.choice(config).map(|c| format!("the better trajectories, {} rows", c.rows.len()));
        InputSpec { chosen, ..self.spec(domains) }
    }

    /// Refuses files that do not fit, and brings all tables into the box.
    fn checked(mut self, own: &Own) -> Result<Self> {
        std::iter::once(&self.target).chain(&self.source).chain(&self.extra).try_for_each(Table::usable)?;
        for other in self.source.iter().chain(&self.extra) {
            ensure_same_agent(&other.rows, &self.target.rows, self.agent)?;
            let (a, b) = (infer_agents(&other.rows), infer_agents(&self.target.rows));
            if self.agent.is_none() && !a.is_empty() && !b.is_empty() && !a.iter().any(|x| b.contains(x)) {
                tce_base::note!(
                    "note: {} looks like {}, {} like {}; if these are robots of the benchmark, they are not the same one",
                    other.file.display(),
                    a[0],
                    self.target.file.display(),
                    b[0]
                );
            }
        }
        self.note_lost_terminals();
        self.refuse_mixed_up()?;
        self.bring_into_the_box(own)?;
        Ok(self)
    }

    /// Tells of logs without a next state wherever an episode ends: models cannot learn from them how episodes end.
    fn note_lost_terminals(&self) {
        let tables = || std::iter::once(&self.target).chain(&self.source);
        let terminal = |t: &Transitions| t.terminals.iter().filter(|&&t| t).count();
        let all: usize = tables().map(|t| terminal(t.complete())).sum();
        let known: usize = tables().map(|t| terminal(&t.rows)).sum();
        if self.agent.is_none() && all > 0 && known == 0 {
            tce_base::note!(
                "warning: {}, and none has a next state: no generated or imagined episode will end early. \
                 Record the state in which an episode ends as `next_observations`",
                counted(all, "row is terminal", "rows are terminal")
            );
        }
    }

    /// Refuses a source that is the target, and warns of one that is smaller: files get mixed up.
    fn refuse_mixed_up(&self) -> Result<()> {
        let Some(source) = &self.source else { return Ok(()) };
        if source.hash == self.target.hash {
            return Err(Error::Usage(format!(
                "{} and {}: found the same data as source and as target; give the log of the old robot as source, and that of the \
                 changed one as target",
                source.file.display(),
                self.target.file.display()
            )));
        }
        let (many, few) = (source.complete().len(), self.target.complete().len());
        if many < few {
            tce_base::note!(
                "warning: the source ({}) has {many} rows, fewer than the target ({}) with {few}; are the two mixed up?",
                source.file.display(),
                self.target.file.display()
            );
        }
        Ok(())
    }

    /// The files of the target's and the source's rows, if there is a source.
    pub fn files(&self) -> Vec<PathBuf> {
        let tables = std::iter::once(&self.target).chain(&self.source);
        tables.map(|t| std::path::absolute(&t.file).unwrap_or_else(|_| t.file.clone())).collect()
    }

    /// What identifies these inputs; without the source for stages that do not look at it.
    pub fn spec(&self, domains: Domains) -> InputSpec {
        InputSpec {
            agent: self.agent,
            shift: self.shift,
            target: self.target.hash.clone(),
            source: self.source.as_ref().filter(|_| domains == Domains::Both).map(|s| s.hash.clone()),
            chosen: None,
            actions: self.actions.clone(),
            step_limit: self.limit,
        }
    }

    /// The source.
    ///
    /// # Errors
    /// If the run has none.
    pub fn source(&self) -> Result<&Table> {
        let source = self.source.as_ref();
        source.ok_or_else(|| Error::Usage("this configuration needs source data; give a file with --source".into()))
    }

    /// The source rows whose successor is known.
    ///
    /// # Errors
    /// If the run has none.
    pub fn source_rows(&self) -> Result<&Transitions> {
        Ok(&self.source()?.rows)
    }

    /// How good the policies were that collected the source and the target rows.
    pub fn behaviour(&self, table: ScoreTable) -> (Option<Behaviour>, Behaviour) {
        let of_source = self.agent.and_then(|agent| reference_scores(agent, Shift::Source, table));
        let limit = self.step_limit();
        let source = self.source.as_ref().map(|s| s.behaviour(of_source, limit));
        (source, self.target.behaviour(self.reference(table), limit))
    }

    /// The steps after which an episode is cut, where that is known: the user said it, or the robot is one of the benchmark's.
    pub fn step_limit(&self) -> Option<usize> {
        self.limit.or(self.agent.map(|_| EPISODE_LIMIT))
    }

    /// The returns that stand for 0 and 100 in the target domain.
    pub fn reference(&self, table: ScoreTable) -> Option<ReferenceScores> {
        reference_scores(self.agent?, self.shift?, table)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_target_rows_are_as_if_the_log_had_ended() {
        let mut t = Transitions::new(1, 1);
        (0..30).for_each(|i| t.push(&[i as f32], &[0.0], i as f32, &[i as f32 + 1.0], i == 14, i == 29));
        let table = |rows: &Transitions| Table::new(rows.clone(), Path::new("t.hdf5"), "h".into());
        let shortened = |rows: usize| {
            let (target, source) = (table(&t), Some(table(&t)));
            let all = Inputs { agent: None, shift: None, target, source, extra: None, actions: None, limit: None };
            all.with_target_rows(rows)
        };
        let inputs = |rows: usize| shortened(rows).unwrap();
        let few = inputs(17);
        assert_eq!(few.target.rows.rewards, (0..17).map(|i| i as f32).collect::<Vec<_>>());
        assert_eq!(few.target.rows.episodes().iter().map(|e| e.end).collect::<Vec<_>>(), [15, 17]);
        assert!(few.target.rows.timeouts[16] && !few.target.rows.terminals[16]);
        assert_eq!(few.target.hash, "h, the first 17 rows");
        // An episode that is over is not cut off.
        let ended = inputs(15).target.rows;
        assert!(ended.terminals[14] && !ended.timeouts[14]);
        for rows in [0, 30, 31] {
            assert_eq!((inputs(rows).target.rows.len(), inputs(rows).target.hash.as_str()), (30, "h"), "{rows}");
        }
        assert_eq!(few.source.unwrap().rows.len(), 30, "the source stays");
        let refused = shortened(3).unwrap_err().to_string();
        assert!(refused.starts_with("target.rows = 3: ") && refused.contains("expected at least 10"), "{refused}");
    }
}
