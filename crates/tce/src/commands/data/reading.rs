//! Reads a file of which the user, or the file's name, says which robot it is of.

use std::path::Path;

use tce_data::{Agent, LoadOptions, Loaded, Problem, Quality, Shift, load};
use tce_run::error::Result;
use tce_run::own::Own;

/// Reads a file; where the user does not name its robot, a public file's name does, if the dimensions agree.
pub(super) fn read(own: &Own, file: &Path) -> Result<(Own, Loaded)> {
    read_with(own, file, Own::load_options)
}

/// [`read`] with other options than the usual ones.
pub(super) fn read_with(own: &Own, file: &Path, options: impl Fn(&Own) -> LoadOptions) -> Result<(Own, Loaded)> {
    let named = Own { env: own.env.or_else(|| environment_of(file)), ..own.clone() };
    match load(file, &options(&named)) {
        Err(e) if own.env.is_none() && e.problem() == Some(Problem::Dimension) => {
            Ok((own.clone(), load(file, &options(own))?))
        }
        loaded => Ok((named, loaded?)),
    }
}

/// What is told of a file whose name, not the user, says which robot it is of.
pub(super) fn named_by_file(given: &Own, taken: &Own) -> Option<String> {
    let (agent, shift) = taken.env.filter(|_| given.env.is_none())?;
    Some(format!(
        "taken for {agent}-{shift}, as the file's name says; augment, learn, compare and diagnose take it for a robot of your own unless \
         you say --env {agent}-{shift}"
    ))
}

/// The environment that the name of a benchmark's file tells: `ant_gravity_0.5_medium.hdf5`, `hopper_medium-v2.hdf5`,
/// `hopper-morph-expert-1a2b3c.hdf5`. Somebody's own `hopper.hdf5`, or `antenna.hdf5`, is a robot like any other.
fn environment_of(path: &Path) -> Option<(Agent, Shift)> {
    let name = path.file_stem()?.to_str()?;
    let agent = Agent::ALL.into_iter().find(|a| name.starts_with(a.name()))?;
    let rest = name[agent.name().len()..].strip_prefix(['-', '_'])?;
    let shifts = [Shift::Gravity5, Shift::Gravity, Shift::Morph, Shift::Kinematic, Shift::Source];
    let shift = shifts.into_iter().find_map(|s| {
        let tail = [s.file_name(), s.name()].into_iter().find_map(|n| rest.strip_prefix(n)?.strip_prefix(['-', '_']));
        tail.map(|tail| (s, tail))
    });
    let (shift, tail) = shift.unwrap_or((Shift::Source, rest));
    // What may follow the quality: D4RL's version, and the hash that our collector appends.
    let tail = tail.replace('_', "-");
    let hex = |t: &str| t.len() >= 6 && t.bytes().all(|b| b.is_ascii_hexdigit());
    let tail = tail.rsplit_once('-').filter(|(_, end)| hex(end)).map_or(tail.as_str(), |(start, _)| start);
    let version = |t: &str| t.strip_prefix('v').is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()));
    let tail = tail.rsplit_once('-').filter(|(_, end)| version(end)).map_or(tail, |(start, _)| start);
    let known = tail == "random" || Quality::ALL.into_iter().any(|q| q.name() == tail);
    known.then_some((agent, shift))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_tell_environments() {
        let env = |name: &str| environment_of(Path::new(name));
        assert_eq!(env("/x/ant_gravity_0.5_medium.hdf5"), Some((Agent::Ant, Shift::Gravity)));
        assert_eq!(env("hopper_morph_expert.hdf5"), Some((Agent::Hopper, Shift::Morph)));
        assert_eq!(env("halfcheetah_medium-v2.hdf5"), Some((Agent::HalfCheetah, Shift::Source)));
        assert_eq!(env("ant_gravity_5.0_medium.hdf5"), Some((Agent::Ant, Shift::Gravity5)));
        assert_eq!(env("hopper-source-medium-5264d44bffc4.hdf5"), Some((Agent::Hopper, Shift::Source)));
        assert_eq!(env("walker2d_kinematic_medium_expert.hdf5"), Some((Agent::Walker2d, Shift::Kinematic)));
        for own in [
            "mine.hdf5",
            "hopper.hdf5",
            "antenna_medium.hdf5",
            "hopper_lab_day3.hdf5",
            "ant.hdf5",
            "hopper_expert_run2.hdf5",
            "hopper_random_walk.hdf5",
        ] {
            assert_eq!(env(own), None, "{own}");
        }
    }
}
