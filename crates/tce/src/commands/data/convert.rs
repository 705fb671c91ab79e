//! `tce data convert`.

use std::path::PathBuf;

use clap::Args;
use tce_base::counted;
use tce_data::{ActionRange, LoadOptions, LoadReport, Loaded, Transitions, read_attributes};
use tce_run::error::{Error, Result};
use tce_run::own::{DataFormat, Own, Writing, range_of};

use super::reading::read_with;
use crate::commands::refuse;
use crate::output::Output;

/// Arguments of `convert`.
#[derive(Debug, Args)]
pub struct Convert {
    /// The file to read.
    input: PathBuf,
    /// The file to write.
    output: PathBuf,
    #[command(flatten)]
    writing: Writing,
    #[command(flatten)]
    own: Own,
}

impl Convert {
    /// Runs the subcommand.
    pub(super) fn run(self, output: Output) -> Result<()> {
        refuse::inputs_as_output(&self.output, &[&self.input])?;
        refuse::data_set(&self.output, &self.writing)?;
        let options = |own: &Own| LoadOptions { all_columns: true, ..own.load_options() };
        let Loaded { transitions, columns, mut report } = read_with(&self.own, &self.input, options)?.1;
        let range = self.action_space(&transitions)?;
        let kept: Vec<(&str, &[f32])> =
            columns.iter().map(|(name, values)| (name.as_str(), values.as_slice())).collect();
        let mut attributes = read_attributes(&self.input)?;
        let origin = if attributes.contains_key("origin") { "converted_from" } else { "origin" };
        attributes.insert(origin.into(), report.to_string());
        if self.writing.format == DataFormat::Minari {
            let lost = lost_in_minari(&report, &transitions, &range, &kept);
            report.warnings.extend(lost);
        }
        self.writing.write(&self.output, &transitions, Some(&range), &attributes, &kept)?;
        output.print(&report, |r| format!("{r}\nwritten to {}", self.output.display()));
        Ok(())
    }

    /// The range of the action space: what the user says of it, that of the named robot, or that of the data.
    fn action_space(&self, rows: &Transitions) -> Result<ActionRange> {
        let columns = rows.act_dim;
        let unit = || ActionRange { low: vec![-1.0; columns], high: vec![1.0; columns] };
        match (&self.own.action_range, self.own.env) {
            (Some(given), _) => range_of(given, columns, &self.input).map_err(Error::Usage),
            // The benchmark's robots take actions in the box.
            (None, Some(_)) => Ok(unit()),
            (None, None) => Ok(ActionRange::of(&[rows]).unwrap_or_else(unit)),
        }
    }
}

/// What of a file a Minari data set cannot hold.
fn lost_in_minari(
    report: &LoadReport,
    rows: &Transitions,
    range: &ActionRange,
    columns: &[(&str, &[f32])],
) -> Vec<String> {
    let mut lost = Vec::new();
    if !columns.is_empty() {
        let names: Vec<&str> = columns.iter().map(|(name, _)| *name).collect();
        lost.push(format!("Minari has no place for these columns, which are left out: {}", names.join(", ")));
    }
    if report.unknown_successors > 0 {
        lost.push(format!(
            "the last observation of {} is not known and repeats the one before; Minari has no mark for that",
            counted(report.unknown_successors, "episode", "episodes")
        ));
    }
    let outside = range.outside(&rows.actions);
    if outside > 0 {
        lost.push(format!(
            "{} outside of {range}, which is written as the range of the actions; --action-range sets another",
            counted(outside, "action value lies", "action values lie")
        ));
    }
    lost
}
