//! Reports of many runs: statistics over tasks and seeds, the tables of the paper beside ours, and
//! the report as HTML, Markdown and LaTeX.
//!
//! [`diagnosis`] shows what `tce diagnose` found. [`study::Study`] holds what there is, [`analysis::analyse`] decides every figure and warning, and [`html`] and [`text`] only
//! print them.
//!
//! ```
//! use tce_report::stats::{Scores, probability_of_improvement};
//!
//! // Scores of two methods on two tasks, three runs each.
//! let ours = Scores::new(vec![vec![90.0, 95.0, 100.0], vec![60.0, 70.0, 80.0]])?;
//! let theirs = Scores::new(vec![vec![50.0, 55.0, 60.0], vec![65.0, 75.0, 85.0]])?;
//! assert_eq!(ours.mean(), 82.5);
//! // All pairs on the first task, three of nine on the second.
//! assert!((probability_of_improvement(&ours, &theirs) - (1.0 + 3.0 / 9.0) / 2.0).abs() < 1e-12);
//! # Ok::<(), tce_report::stats::StatsError>(())
//! ```

pub mod analysis;
pub mod diagnosis;
pub mod difference;
pub mod error;
pub mod folder;
pub mod html;
pub mod merge;
pub mod paper;
pub mod permutation;
pub mod record;
pub mod sensitivity;
pub mod stats;
pub mod study;
pub mod svg;
pub mod text;

pub use analysis::{Analysis, Options, analyse};
pub use diagnosis::page as diagnosis_page;
pub use error::{ReportError, Result};
pub use folder::RunFolder;
pub use merge::{merge, mixed};
pub use study::{Budget, Change, Cost, Method, Missing, Recipe, Recommended, Run, Study, Work};

use std::path::{Path, PathBuf};

use tce_base::write_atomically;

/// Writes `report.html`, `report.md` and `report.tex` into `directory`.
///
/// # Errors
/// If a file cannot be written.
pub fn write(study: &Study, analysis: &Analysis, directory: &Path) -> Result<Vec<PathBuf>> {
    let files = [
        ("report.html", html::page(study, analysis)),
        ("report.md", text::markdown(study, analysis)),
        ("report.tex", text::latex(study, analysis)),
    ];
    let mut written = Vec::new();
    for (name, text) in files {
        let path = directory.join(name);
        write_atomically(&path, text.as_bytes())?;
        written.push(path);
    }
    Ok(written)
}
