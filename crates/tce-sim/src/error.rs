//! Errors of the simulator, and of finding its library.

use std::path::PathBuf;

use tce_data::{Agent, Shift};

/// The version confirmed by replaying the public data sets. Version 4.0.0 deviates on Ant (p99 about 1e-3).
pub(crate) const VERSION: &str = "3.17.0";

/// The library's file name, in the wheel and in all search places.
pub(crate) const FILE: &str = "libmujoco.so.3.17.0";

/// Environment variable with the path of the user's own library. If it is set, no other library is tried.
pub(crate) const VARIABLE: &str = "TCE_MUJOCO_LIB";

/// Instructions for the user.
pub(crate) const HELP: &str = "To get the library:\n  \
     pip install --no-deps --only-binary=:all: --python-version 3.12 --target mujoco-3.17.0 mujoco==3.17.0\n  \
     export TCE_MUJOCO_LIB=$PWD/mujoco-3.17.0/mujoco/libmujoco.so.3.17.0\n\
     or copy that file beside the program. Only commands that simulate need it.";

/// Why there is no simulator.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// None of the search places contains the library.
    #[error("{FILE}, the simulator, is not here. Looked for it at:\n{places}{HELP}")]
    Missing {
        /// One line for each place.
        places: String,
    },
    /// The environment variable is set, but there is no such file.
    #[error("{VARIABLE} is `{}`: found no such file, expected the path of {FILE}.\n{HELP}", path.display())]
    Named {
        /// The path in the variable.
        path: PathBuf,
    },
    /// The file is not a library, or not one for this machine.
    #[error("{}: this is not a MuJoCo that can be used here: {reason}.\nPut {FILE} in its place.\n{HELP}", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// The message of the operating system.
        reason: String,
    },
    /// The processor does not support the instructions of MuJoCo's build.
    #[error("this processor lacks AVX, which {FILE} needs; commands that do not simulate work without it")]
    Processor,
    /// The MuJoCo version differs from the one that the models are made for.
    #[error("{}: found MuJoCo {found}, expected {VERSION}, with which the models were checked.\n{HELP}", path.display())]
    Version {
        /// The library file.
        path: PathBuf,
        /// Its version.
        found: String,
    },
}

/// Errors of the simulator.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// MuJoCo rejected a generated model: a bug of this program.
    #[error("model {agent}-{shift}: MuJoCo refuses it: {message}")]
    Model {
        /// Robot.
        agent: Agent,
        /// Shift.
        shift: Shift,
        /// MuJoCo's message.
        message: String,
    },
    /// MuJoCo was not found, or its version differs from the one that the models are made for.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// A table or buffer does not have the robot's dimensions.
    #[error("{what}: found {found}, expected {expected} for {agent}")]
    Dimension {
        /// What has the wrong size.
        what: &'static str,
        /// Robot.
        agent: Agent,
        /// Size found.
        found: usize,
        /// Size expected.
        expected: usize,
    },
    /// An option is out of its range.
    #[error("{option}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        option: &'static str,
        /// The value.
        found: usize,
        /// The allowed values.
        expected: &'static str,
    },
    /// A number is not finite.
    #[error("{what}, row {row}: found {value}, expected a finite number")]
    NotFinite {
        /// The table that contains it.
        what: &'static str,
        /// Its row.
        row: usize,
        /// The value.
        value: f32,
    },
    /// The physics blew up repeatedly.
    #[error(
        "{agent}-{shift}: the simulation became unstable {count} times in {rows} rows; the actor's actions drive it \
         there, check the policy"
    )]
    Unstable {
        /// Robot.
        agent: Agent,
        /// Shift.
        shift: Shift,
        /// Number of abandoned episodes.
        count: usize,
        /// Rows collected up to then.
        rows: usize,
    },
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
}
