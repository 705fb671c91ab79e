use tce_data::{Agent, Shift};

use crate::library::LibraryError;

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
    #[error("interrupted")]
    Interrupted,
}
