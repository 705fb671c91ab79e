//! The progress of a whole command: a line above the bars with the running step and, if known, the time left.
//!
//! An estimate uses measured costs only. A step's cost is known once a step of the same kind has come to its end, in
//! this command or, where the command names a file for costs, in an earlier one on this machine; of the step under way also where its
//! last bar shows it. If the cost of one remaining step is unknown, no time is shown.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use crate::files::{read_if_there, write_json};
use crate::format::about;
use crate::terminal::{Counter, LINES, in_place};

/// A step of a command.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// What [`begin_step`] calls it.
    pub name: String,
    /// Steps of one kind cost the same for every unit of their size.
    pub kind: String,
    /// The size, in whatever unit its kind has; 0 for what costs nothing.
    pub size: f64,
    /// How the label of the step's last bar begins; the time that this bar has left is the step's.
    pub last_bar: Option<&'static str>,
}

impl Step {
    /// A step of size 1, whose bars tell nothing of the whole step.
    pub fn new(name: impl Into<String>, kind: impl Into<String>) -> Self {
        Self { name: name.into(), kind: kind.into(), size: 1.0, last_bar: None }
    }

    /// The same of another size.
    pub fn sized(self, size: f64) -> Self {
        Self { size, ..self }
    }

    /// The same with a bar that tells what is left.
    pub fn ending_in(self, last_bar: &'static str) -> Self {
        Self { last_bar: Some(last_bar), ..self }
    }
}

#[derive(Default)]
struct Course {
    steps: Vec<Step>,
    /// The step under way, its beginning, and its newest bar; a step without one was done before.
    at: Option<usize>,
    began: Option<Instant>,
    bar: Option<Weak<Counter>>,
    worked: bool,
    /// Whether an earlier command has done a part of the step: what is left of it tells nothing of its cost.
    resumed: bool,
    /// Seconds per unit of size, by kind.
    costs: BTreeMap<String, f64>,
    memory: Option<PathBuf>,
}

impl Course {
    fn begin(&mut self, name: &str, now: Instant) {
        let from = self.at.map_or(0, |at| at + 1);
        if self.at.is_some_and(|at| self.steps[at].name == name) {
            return;
        }
        let Some(next) = (from..self.steps.len()).find(|i| self.steps[*i].name == name) else { return };
        self.end(now);
        (self.at, self.began, self.bar) = (Some(next), Some(now), None);
        (self.worked, self.resumed) = (false, false);
    }

    /// Remembers what the step under way has cost.
    fn end(&mut self, now: Instant) {
        if let (Some(at), Some(began), true) = (self.at, self.began, self.worked && !self.resumed)
            && self.steps[at].size > 0.0
        {
            let step = &self.steps[at];
            self.costs.insert(step.kind.clone(), (now - began).as_secs_f64() / step.size);
        }
    }

    fn cost(&self, step: &Step) -> Option<f64> {
        if step.size == 0.0 {
            return Some(0.0);
        }
        self.costs.get(&step.kind).map(|cost| cost * step.size)
    }

    /// Seconds that are left.
    fn left(&self, now: Instant) -> Option<f64> {
        let at = self.at?;
        let step = &self.steps[at];
        let bar = self.bar.as_ref().and_then(Weak::upgrade);
        let told = bar.filter(|b| step.last_bar.is_some_and(|l| b.label.starts_with(l))).and_then(|b| b.left());
        let elapsed = self.began.map_or(0.0, |began| (now - began).as_secs_f64());
        // A step that takes longer than the last one of its kind has shown that nobody knows.
        let by_cost =
            || self.cost(step).filter(|cost| elapsed < 1.2 * cost + 5.0).map(|cost| (cost - elapsed).max(0.0));
        let own = told.or_else(by_cost)?;
        self.steps[at + 1..].iter().map(|s| self.cost(s)).try_fold(own, |sum, cost| Some(sum + cost?))
    }

    fn line(&self, now: Instant) -> String {
        let Some(at) = self.at else { return String::new() };
        let left = self.left(now).map_or_else(String::new, |s| format!(", {} left", about(s)));
        format!("step {} of {}{left}: {}", at + 1, self.steps.len(), self.steps[at].name)
    }
}

static COURSE: Mutex<Option<Course>> = Mutex::new(None);
static HEADLINE: Mutex<Option<Headline>> = Mutex::new(None);

/// Never held while a line is drawn or changed: the line above the bars asks for it while it is drawn.
fn course() -> MutexGuard<'static, Option<Course>> {
    COURSE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Plans the steps of the command, in their order. `memory` is a file with what such steps have cost on this machine, to be
/// read now and kept up to date.
pub fn plan_course(steps: Vec<Step>, memory: Option<PathBuf>) {
    let known = memory.as_ref().and_then(|path| read_if_there(path).ok().flatten());
    let costs = known.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
    *course() = Some(Course { steps, costs, memory, ..Course::default() });
}

/// The step `name` begins, if it was planned and has not run yet.
pub fn begin_step(name: &str) {
    let (line, keep) = {
        let mut course = course();
        let Some(course) = course.as_mut() else { return };
        let worked = course.worked;
        course.begin(name, Instant::now());
        (course.at.is_some(), worked.then(|| course.memory.clone().zip(Some(course.costs.clone()))).flatten())
    };
    remember(keep);
    let mut headline = HEADLINE.lock().unwrap_or_else(PoisonError::into_inner);
    match &*headline {
        Some(headline) => headline.draw(),
        None if line => {
            let text = || course().as_ref().map_or_else(String::new, |c| c.line(Instant::now()));
            *headline = Some(Headline::drawn_by(text));
        }
        None => {}
    }
}

/// The step under way goes on from a checkpoint: its time is not remembered as the cost of a whole one.
pub fn resume_step() {
    if let Some(course) = course().as_mut() {
        course.resumed = true;
    }
}

/// How the last step of a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LastStep {
    /// It is done: what it cost is remembered.
    Done,
    /// An error or an interruption ended it.
    BrokenOff,
}

/// The command has come to its end, so that its line goes away.
pub fn end_course(last: LastStep) {
    let ended = course().take();
    drop(HEADLINE.lock().unwrap_or_else(PoisonError::into_inner).take());
    if let (Some(mut course), true) = (ended, last == LastStep::Done) {
        let before = course.costs.clone();
        course.end(Instant::now());
        // A command that found everything done changes nothing.
        if course.costs != before {
            remember(course.memory.zip(Some(course.costs)));
        }
    }
}

/// Costs are a convenience: what cannot be kept is not.
fn remember(costs: Option<(PathBuf, BTreeMap<String, f64>)>) {
    if let Some((path, costs)) = costs.filter(|(path, _)| path.parent().is_some_and(|p| p.exists())) {
        let _ = write_json(&path, &costs);
    }
}

/// A bar begins: the step under way is being worked at.
pub(crate) fn works(counter: &Arc<Counter>) {
    if let Some(course) = course().as_mut() {
        (course.worked, course.bar) = (true, Some(Arc::downgrade(counter)));
    }
}

/// A line above all bars, where lines can change in place; nothing elsewhere. It goes away when it is dropped.
pub struct Headline(Option<ProgressBar>);

impl Headline {
    /// A line whose text is asked for whenever it is drawn.
    pub fn drawn_by(text: impl Fn() -> String + Clone + Send + Sync + 'static) -> Self {
        Self(in_place().then(|| {
            let style = ProgressStyle::with_template("{text:.bold}").expect("a constant template");
            let style = style.with_key("text", move |_: &ProgressState, out: &mut dyn std::fmt::Write| {
                let _ = out.write_str(&text());
            });
            let bar = LINES.insert(0, ProgressBar::new_spinner().with_style(style));
            bar.enable_steady_tick(Duration::from_millis(500));
            bar
        }))
    }

    /// Draws the line now. A step may be over before the next tick, and indicatif skips drawings that follow each other closely.
    fn draw(&self) {
        if let Some(bar) = &self.0 {
            bar.force_draw();
        }
    }
}

impl Drop for Headline {
    fn drop(&mut self) {
        if let Some(bar) = &self.0 {
            bar.finish_and_clear();
            LINES.remove(bar);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;

    fn course() -> Course {
        let steps = vec![
            Step::new("data", "data"),
            Step::new("one", "clone").sized(2.0).ending_in("learn"),
            Step::new("two", "clone").sized(4.0).ending_in("learn"),
        ];
        Course { steps, ..Course::default() }
    }

    fn counter(label: &str, done: u64, began: Instant) -> Arc<Counter> {
        Arc::new(Counter { label: label.into(), total: 100, done: AtomicU64::new(done), started: began })
    }

    #[test]
    fn no_time_is_told_before_every_cost_is_known() {
        let (mut c, start) = (course(), Instant::now());
        let after = |s: u64| start + Duration::from_secs(s);
        assert_eq!(c.line(start), "");
        c.begin("data", start);
        c.worked = true;
        assert_eq!(c.line(after(5)), "step 1 of 3: data");
        c.begin("one", after(10));
        c.worked = true;
        assert_eq!(c.line(after(20)), "step 2 of 3: one");
        // 60 s for a size of 2: 120 s for one of 4.
        c.begin("two", after(70));
        assert_eq!(c.line(after(70)), "step 3 of 3, about 2 min left: two");
        assert_eq!(c.line(after(180)), "step 3 of 3, less than a minute left: two");
        assert_eq!(c.line(after(300)), "step 3 of 3: two", "it takes longer than the other one");
    }

    #[test]
    fn a_step_that_was_done_before_costs_nothing_and_tells_nothing() {
        let (mut c, start) = (course(), Instant::now());
        c.begin("one", start);
        c.begin("two", start);
        assert_eq!((c.line(start).as_str(), c.costs.len()), ("step 3 of 3: two", 0));
        c.begin("data", start);
        assert_eq!(c.line(start), "step 3 of 3: two", "what is behind does not come again");
    }

    #[test]
    fn a_step_that_goes_on_from_a_checkpoint_has_no_cost() {
        let (mut c, start) = (course(), Instant::now());
        c.costs.insert("clone".into(), 30.0);
        c.begin("one", start);
        (c.worked, c.resumed) = (true, true);
        c.begin("two", start + Duration::from_secs(1));
        assert_eq!((c.costs["clone"], c.resumed), (30.0, false), "the cost of a whole step stays");
    }

    #[test]
    fn the_last_bar_of_a_step_tells_what_is_left_of_it() {
        let now = Instant::now();
        let Some(began) = now.checked_sub(Duration::from_secs(100)) else { return };
        let mut c = course();
        c.begin("two", began);
        for (label, line) in [("learn bc", "step 3 of 3, about 4 min left: two"), ("train cvae", "step 3 of 3: two")] {
            let counter = counter(label, 30, began);
            c.bar = Some(Arc::downgrade(&counter));
            assert_eq!(c.line(now), line);
        }
    }
}
