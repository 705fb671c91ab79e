//! Where the picture is taken from.

use tce_data::Agent;

use crate::models::inertia::{dot, minus};
use crate::models::robot::Vec3;

/// `a + t b`.
pub(super) fn along(a: Vec3, t: f64, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] + t * b[i])
}

pub(super) fn unit(a: Vec3) -> Vec3 {
    let length = dot(a, a).sqrt();
    a.map(|x| x / length)
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A pinhole camera that stands upright. Pixel (0, 0) has its top left corner at the picture's.
#[derive(Clone, Copy, Debug)]
pub(super) struct Camera {
    pub position: Vec3,
    /// Unit vectors: into the picture, to its right, and down.
    forward: Vec3,
    right: Vec3,
    down: Vec3,
    /// Pixels per metre at a distance of one metre.
    focal: f64,
    /// The pixel coordinates of what the camera looks at.
    centre: [f64; 2],
}

impl Camera {
    /// A camera at `position` that looks at `target`. A picture `size` pixels wide and high shows `height` metres from top to
    /// bottom at the target's distance.
    pub fn new(position: Vec3, target: Vec3, height: f64, [width, rows]: [usize; 2]) -> Self {
        let gaze = minus(target, position);
        let forward = unit(gaze);
        let right = unit(cross(forward, [0.0, 0.0, 1.0]));
        let focal = rows as f64 * dot(gaze, gaze).sqrt() / height;
        let centre = [width as f64 / 2.0, rows as f64 / 2.0];
        Self { position, forward, right, down: cross(forward, right), focal, centre }
    }

    /// The camera that follows `agent`, whose torso is at `torso`. It keeps its height, so that hops are seen, unless the robot
    /// would leave the picture.
    pub fn following(agent: Agent, torso: Vec3, size: [usize; 2]) -> Self {
        let View { offset, level, height, headroom, .. } = View::of(agent);
        let lift = (torso[2] - headroom).max(0.0);
        let (x, y) = (torso[0], if agent == Agent::Ant { torso[1] } else { 0.0 });
        let target = [x, y, level + lift];
        // A narrow picture shows as much from left to right as one of 4 by 3.
        let height = height * (4.0 / 3.0 * size[1] as f64 / size[0] as f64).max(1.0);
        Self::new(along(target, 1.0, offset), target, height, size)
    }

    /// Where a point is seen, in pixels, and how far away it is along the camera's axis; none behind the camera.
    pub fn project(&self, point: Vec3) -> Option<([f64; 2], f64)> {
        let p = minus(point, self.position);
        let depth = dot(p, self.forward);
        if depth < 1e-3 {
            return None;
        }
        let scale = self.focal / depth;
        Some(([self.centre[0] + scale * dot(p, self.right), self.centre[1] + scale * dot(p, self.down)], depth))
    }

    /// The direction of what is seen at (`x`, `y`), of length 1 along the camera's axis: `position + t ray` has depth t.
    pub fn ray(&self, x: f64, y: f64) -> Vec3 {
        let (u, v) = ((x - self.centre[0]) / self.focal, (y - self.centre[1]) / self.focal);
        std::array::from_fn(|i| self.forward[i] + u * self.right[i] + v * self.down[i])
    }

    /// Pixels per metre at `depth`.
    pub fn scale(&self, depth: f64) -> f64 {
        self.focal / depth
    }
}

/// The pattern of the ground.
#[derive(Clone, Copy, Debug)]
pub(super) struct Floor {
    /// Side of a square, m.
    pub square: f64,
    /// Depth from which on it fades into the sky, m.
    pub fade: f64,
}

/// How an agent is looked at.
pub(super) struct View {
    /// From what is looked at to the camera, m.
    offset: Vec3,
    /// Height above the ground of what is looked at, m.
    level: f64,
    /// Metres from the picture's top to its bottom, at the target's distance.
    height: f64,
    /// Height of the torso from which on the camera rises with it, m.
    headroom: f64,
    /// What is below it. Far off, squares become too small to be told apart; from above, where more of them are seen, they are larger.
    pub floor: Floor,
}

impl View {
    pub fn of(agent: Agent) -> Self {
        const FLOOR: Floor = Floor { square: 0.5, fade: 5.5 };
        match agent {
            // From the side; forward is to the right.
            Agent::Hopper | Agent::Walker2d => {
                View { offset: [0.0, -5.2, 0.5], level: 0.93, height: 2.5, headroom: 1.6, floor: FLOOR }
            }
            Agent::HalfCheetah => {
                View { offset: [0.0, -5.2, 0.8], level: 0.6, height: 2.0, headroom: 1.1, floor: FLOOR }
            }
            // From above and beside, a little ahead: high enough for the legs behind the torso.
            Agent::Ant => View {
                offset: [1.3, -3.7, 3.7],
                level: 0.3,
                height: 2.9,
                headroom: 1.4,
                floor: Floor { square: 1.0, fade: 8.0 },
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: [f64; 2], expected: [f64; 2]) {
        assert!((0..2).all(|i| (found[i] - expected[i]).abs() < 1e-9), "{found:?} instead of {expected:?}");
    }

    /// 4 m away, 2 m are seen over 100 rows: 50 pixels per metre there, focal length 200 pixels.
    #[test]
    fn points_are_seen_where_geometry_says() {
        let camera = Camera::new([1.0, -4.0, 1.0], [1.0, 0.0, 1.0], 2.0, [160, 100]);
        let at = |p| camera.project(p).unwrap();
        close(at([1.0, 0.0, 1.0]).0, [80.0, 50.0]);
        close(at([2.0, 0.0, 1.5]).0, [130.0, 25.0]);
        // Twice as far away: half as far from the centre.
        close(at([2.0, 4.0, 1.5]).0, [105.0, 37.5]);
        assert!((at([2.0, 4.0, 1.5]).1 - 8.0).abs() < 1e-12);
        assert!(camera.project([1.0, -5.0, 1.0]).is_none());
        assert!((camera.scale(4.0) - 50.0).abs() < 1e-12);
    }

    /// A camera 3 m beside and 4 m above its target, 5 m away: what lies 1 m to its right is 1/5 of the focal length of 500 off.
    #[test]
    fn a_raised_camera_stays_upright() {
        let camera = Camera::new([0.0, -3.0, 4.0], [0.0; 3], 1.0, [100, 100]);
        close(camera.project([1.0, 0.0, 0.0]).unwrap().0, [150.0, 50.0]);
        close(camera.project([0.0; 3]).unwrap().0, [50.0, 50.0]);
        // 1 m up the vertical: 0.8 m nearer along the axis (0, 0.6, -0.8), 0.6 m up in the picture: 500 * 0.6 / 4.2.
        close(camera.project([0.0, 0.0, 1.0]).unwrap().0, [50.0, 50.0 - 500.0 * 0.6 / 4.2]);
    }

    #[test]
    fn rays_meet_what_is_seen_there() {
        let camera = Camera::following(Agent::Ant, [3.0, -2.0, 0.6], [320, 240]);
        let point = [3.4, -1.3, 0.2];
        let ([x, y], depth) = camera.project(point).unwrap();
        let back = along(camera.position, depth, camera.ray(x, y));
        assert!((0..3).all(|i| (back[i] - point[i]).abs() < 1e-9), "{back:?}");
    }

    #[test]
    fn the_camera_follows_the_torso() {
        for agent in Agent::ALL {
            let here = Camera::following(agent, [0.0, 0.0, 0.9], [480, 360]);
            let there = Camera::following(agent, [17.3, 0.0, 0.9], [480, 360]);
            let (a, b) = (here.project([0.0, 0.0, 0.9]).unwrap(), there.project([17.3, 0.0, 0.9]).unwrap());
            close(a.0, b.0);
            // In the picture's middle third.
            assert!((160.0..320.0).contains(&a.0[0]) && (60.0..240.0).contains(&a.0[1]), "{agent}: {a:?}");
            let high = Camera::following(agent, [0.0, 0.0, 5.0], [480, 360]).project([0.0, 0.0, 5.0]).unwrap().0;
            assert!((0.0..180.0).contains(&high[1]), "{agent} stays in the picture: {high:?}");
        }
        let aside = Camera::following(Agent::Ant, [0.0, 8.0, 0.6], [480, 360]);
        assert!((aside.project([0.0, 8.0, 0.6]).unwrap().0[0] - 240.0).abs() < 1e-9);
    }
}
