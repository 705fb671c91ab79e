//! What can go wrong in the simulator, and before there is one.

use std::path::PathBuf;

use tce_data::{Agent, Shift};

/// The version that the replayed data sets confirm; 4.0.0 drifts on Ant (p99 about 1e-3).
pub(crate) const VERSION: &str = "3.17.0";

/// The library's name, in the wheel and wherever it is looked for.
pub(crate) const FILE: &str = "libmujoco.so.3.17.0";

/// Names a library of the user's own, which is then the only one that is tried.
pub(crate) const VARIABLE: &str = "TCE_MUJOCO_LIB";

/// What to do about it.
pub(crate) const HELP: &str = "To get the library:\n  \
     pip install --no-deps --only-binary=:all: --python-version 3.12 --target mujoco-3.17.0 mujoco==3.17.0\n  \
     export TCE_MUJOCO_LIB=$PWD/mujoco-3.17.0/mujoco/libmujoco.so.3.17.0\n\
     or copy that file beside the program. Only commands that simulate need it.";

/// Why there is no simulator.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// No library lies where one is looked for.
    #[error("{FILE}, the simulator, is not here. Looked for it at:\n{places}{HELP}")]
    Missing {
        /// A line for each place.
        places: String,
    },
    /// The variable that names a library names none.
    #[error("{VARIABLE} is `{}`: found no such file, expected the path of {FILE}.\n{HELP}", path.display())]
    Named {
        /// What the variable says.
        path: PathBuf,
    },
    /// The file that was found is no library, or not one for this machine.
    #[error("{}: this is not a MuJoCo that can be used here: {reason}.\nPut {FILE} in its place.\n{HELP}", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: String,
    },
    /// The processor is older than MuJoCo's build.
    #[error("this processor lacks AVX, which {FILE} needs; commands that do not simulate work without it")]
    Processor,
    /// Another MuJoCo than the one the models are made for.
    #[error("{}: found MuJoCo {found}, expected {VERSION}, with which the models were checked.\n{HELP}", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: String,
    },
}

/// What can go wrong in the simulator.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// MuJoCo refused a generated model: a fault of this program.
    #[error("model {agent}-{shift}: MuJoCo refuses it: {message}")]
    Model {
        /// Robot.
        agent: Agent,
        /// Shift.
        shift: Shift,
        /// MuJoCo's message.
        message: String,
    },
    /// There is no MuJoCo, or another one than the models are made for.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// A table or buffer does not have the robot's dimensions.
    #[error("{what}: found {found}, expected {expected} for {agent}")]
    Dimension {
        /// What was measured.
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
        /// Value found.
        found: usize,
        /// What is allowed.
        expected: &'static str,
    },
    /// A number that must be finite is not.
    #[error("{what}, row {row}: found {value}, expected a finite number")]
    NotFinite {
        /// Which table.
        what: &'static str,
        /// Row in it.
        row: usize,
        /// The value.
        value: f32,
    },
    /// The physics blew up again and again.
    #[error(
        "{agent}-{shift}: the simulation became unstable {count} times in {rows} rows; the actor's actions drive it \
         there, check the policy"
    )]
    Unstable {
        /// Robot.
        agent: Agent,
        /// Shift.
        shift: Shift,
        /// Episodes given up.
        count: usize,
        /// Rows collected by then.
        rows: usize,
    },
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
}
