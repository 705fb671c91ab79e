//! The twenty models: one description per robot and one edit per shift; the MJCF is generated from both.

mod agents;
mod compiled;
mod difference;
pub mod inertia;
mod mjcf;
pub mod robot;
mod shifts;

use tce_data::{Agent, Shift};

pub use compiled::compiled;
pub use difference::{Difference, difference};

use robot::Robot;

/// The description of `agent`'s body under `shift`.
pub fn robot(agent: Agent, shift: Shift) -> Robot {
    let mut robot = agents::robot(agent);
    robot.name = format!("{agent}_{}", shift.file_name());
    shifts::apply(agent, shift, &mut robot);
    robot
}

/// The MuJoCo model of `agent` under `shift`, as MJCF (XML) text.
pub fn mjcf(agent: Agent, shift: Shift) -> String {
    mjcf::write(&robot(agent, shift))
}
