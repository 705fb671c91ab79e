//! Compares two descriptions of one robot part by part, to find what a shift changed.

use std::collections::BTreeSet;

use tce_data::{Agent, Shift};

use super::robot;

/// The differences between a shifted robot and the unshifted one.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Bodies with a geom of another size, shape or position within the body. A body that is only attached elsewhere,
    /// because its parent has another length, does not count: it is the same part.
    pub reshaped: Vec<String>,
    /// Bodies with a joint of another range, axis or position.
    pub restricted: Vec<String>,
    /// The changed geoms, and all geoms of bodies with a changed joint.
    pub geoms: BTreeSet<String>,
    /// Gravity as a multiple of the source's.
    pub gravity: f64,
}

/// The changes that `shift` makes to `agent`.
pub fn difference(agent: Agent, shift: Shift) -> Difference {
    let (source, target) = (robot(agent, Shift::Source), robot(agent, shift));
    let mut old = Vec::new();
    source.torso.visit(&mut |body| old.push(body));
    let mut out = Difference {
        reshaped: Vec::new(),
        restricted: Vec::new(),
        geoms: BTreeSet::new(),
        gravity: target.gravity / source.gravity,
    };
    let mut old = old.into_iter();
    target.torso.visit(&mut |body| {
        let before = old.next().expect("a shift adds no bodies");
        let joints = body.joints != before.joints;
        if joints {
            out.restricted.push(body.name.clone());
        }
        let mut reshaped = false;
        for (geom, before) in body.geoms.iter().zip(&before.geoms) {
            let other = (geom.radius, geom.shape) != (before.radius, before.shape);
            reshaped |= other;
            if joints || other {
                out.geoms.insert(geom.name.clone());
            }
        }
        if reshaped {
            out.reshaped.push(body.name.clone());
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(agent: Agent, shift: Shift) -> (String, String, f64) {
        let d = difference(agent, shift);
        (d.reshaped.join(" "), d.restricted.join(" "), d.gravity)
    }

    #[test]
    fn shifts_change_what_they_say() {
        let expected =
            |reshaped: &str, restricted: &str, gravity| (reshaped.to_owned(), restricted.to_owned(), gravity);
        use Agent::*;
        for agent in Agent::ALL {
            assert_eq!(found(agent, Shift::Source), expected("", "", 1.0));
            assert_eq!(found(agent, Shift::Gravity), expected("", "", 0.5));
            assert_eq!(found(agent, Shift::Gravity5), expected("", "", 5.0));
        }
        assert_eq!(found(Hopper, Shift::Morph), expected("torso thigh", "", 1.0));
        assert_eq!(found(Walker2d, Shift::Morph), expected("thigh leg", "", 1.0));
        assert_eq!(found(HalfCheetah, Shift::Morph), expected("bthigh bshin bfoot fthigh fshin", "", 1.0));
        assert_eq!(found(Ant, Shift::Morph), expected("ankle_1 ankle_2", "", 1.0));
        assert_eq!(found(Hopper, Shift::Kinematic), expected("", "thigh foot", 1.0));
        assert_eq!(found(Walker2d, Shift::Kinematic), expected("", "foot", 1.0));
        assert_eq!(found(HalfCheetah, Shift::Kinematic), expected("", "bthigh", 1.0));
        assert_eq!(found(Ant, Shift::Kinematic), expected("", "hip_1 hip_2", 1.0));
        let hips = difference(Ant, Shift::Kinematic).geoms;
        assert_eq!(hips.into_iter().collect::<Vec<_>>(), ["leg_1_geom", "leg_2_geom"]);
    }
}
