//! The camera and the view of each robot.

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

/// A pinhole camera without roll. The top left corner of pixel (0, 0) is that of the picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Camera {
    pub position: Vec3,
    /// Unit vectors: forward, right and down.
    forward: Vec3,
    right: Vec3,
    down: Vec3,
    /// Pixels per metre at a distance of one metre.
    focal: f64,
    /// The pixel coordinates of the camera's target.
    centre: [f64; 2],
}

impl Camera {
    /// A camera at `position` that points at `target`. A picture of the given size in pixels shows `height` metres from
    /// top to bottom at the target's distance.
    pub fn new(position: Vec3, target: Vec3, height: f64, [width, rows]: [usize; 2]) -> Self {
        let gaze = minus(target, position);
        let forward = unit(gaze);
        let right = unit(cross(forward, [0.0, 0.0, 1.0]));
        let focal = rows as f64 * dot(gaze, gaze).sqrt() / height;
        let centre = [width as f64 / 2.0, rows as f64 / 2.0];
        Self { position, forward, right, down: cross(forward, right), focal, centre }
    }

    /// The camera that follows `agent`, whose torso is at `torso`. It keeps its height, so that hops are visible,
    /// unless the robot would leave the picture.
    pub fn following(agent: Agent, torso: Vec3, size: [usize; 2]) -> Self {
        let View { offset, level, height, headroom, .. } = View::of(agent);
        let lift = (torso[2] - headroom).max(0.0);
        let (x, y) = (torso[0], if agent == Agent::Ant { torso[1] } else { 0.0 });
        let target = [x, y, level + lift];
        // A narrow picture shows as much from left to right as a picture of 4 by 3.
        let height = height * (4.0 / 3.0 * size[1] as f64 / size[0] as f64).max(1.0);
        Self::new(along(target, 1.0, offset), target, height, size)
    }

    /// The pixel coordinates of a point, and its depth along the camera's axis; `None` if it is behind the camera.
    pub fn project(&self, point: Vec3) -> Option<([f64; 2], f64)> {
        let p = minus(point, self.position);
        let depth = dot(p, self.forward);
        if depth < 1e-3 {
            return None;
        }
        let scale = self.focal / depth;
        Some(([self.centre[0] + scale * dot(p, self.right), self.centre[1] + scale * dot(p, self.down)], depth))
    }

    /// The direction of the ray through the pixel coordinates (`x`, `y`). Its component along the camera's axis is 1,
    /// so `position + t ray` has depth t.
    pub fn ray(&self, x: f64, y: f64) -> Vec3 {
        let (u, v) = ((x - self.centre[0]) / self.focal, (y - self.centre[1]) / self.focal);
        std::array::from_fn(|i| self.forward[i] + u * self.right[i] + v * self.down[i])
    }

    /// Pixels per metre at `depth`.
    pub fn scale(&self, depth: f64) -> f64 {
        self.focal / depth
    }
}

/// The pattern of the floor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Floor {
    /// Side of a square of the pattern, m.
    pub square: f64,
    /// Depth at which the floor starts to fade into the sky, m.
    pub fade: f64,
}

/// The view of an agent.
pub(super) struct View {
    /// Offset from the target to the camera, m.
    offset: Vec3,
    /// Height of the target above the ground, m.
    level: f64,
    /// Metres from the picture's top to its bottom, at the target's distance.
    height: f64,
    /// Height of the torso above which the camera rises with it, m.
    headroom: f64,
    /// The floor pattern. Distant squares are too small to distinguish; the view from above shows more, so it has
    /// larger ones.
    pub floor: Floor,
}

impl View {
    pub fn of(agent: Agent) -> Self {
        const FLOOR: Floor = Floor { square: 0.5, fade: 5.5 };
        match agent {
            // Side view; forward is to the right.
            Agent::Hopper | Agent::Walker2d => {
                View { offset: [0.0, -5.2, 0.5], level: 0.93, height: 2.5, headroom: 1.6, floor: FLOOR }
            }
            Agent::HalfCheetah => {
                View { offset: [0.0, -5.2, 0.8], level: 0.6, height: 2.0, headroom: 1.1, floor: FLOOR }
            }
            // View from above and from the side, a little ahead: high enough to show the legs behind the torso.
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

    /// At a distance of 4 m, 100 rows show 2 m: 50 pixels per metre there, focal length 200 pixels.
    #[test]
    fn points_are_seen_where_geometry_says() {
        let camera = Camera::new([1.0, -4.0, 1.0], [1.0, 0.0, 1.0], 2.0, [160, 100]);
        let at = |p| camera.project(p).unwrap();
        close(at([1.0, 0.0, 1.0]).0, [80.0, 50.0]);
        close(at([2.0, 0.0, 1.5]).0, [130.0, 25.0]);
        // At twice the distance, the point is half as far from the centre.
        close(at([2.0, 4.0, 1.5]).0, [105.0, 37.5]);
        assert!((at([2.0, 4.0, 1.5]).1 - 8.0).abs() < 1e-12);
        assert!(camera.project([1.0, -5.0, 1.0]).is_none());
        assert!((camera.scale(4.0) - 50.0).abs() < 1e-12);
    }

    /// A camera 3 m beside and 4 m above its target (5 m away). A point 1 m to the right is off by 1/5 of the focal
    /// length, 500.
    #[test]
    fn a_raised_camera_stays_upright() {
        let camera = Camera::new([0.0, -3.0, 4.0], [0.0; 3], 1.0, [100, 100]);
        close(camera.project([1.0, 0.0, 0.0]).unwrap().0, [150.0, 50.0]);
        close(camera.project([0.0; 3]).unwrap().0, [50.0, 50.0]);
        // 1 m higher: 0.8 m nearer along the axis (0, 0.6, -0.8), and 0.6 m higher in the picture: 500 * 0.6 / 4.2.
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
            // The point is in the middle third of the picture.
            assert!((160.0..320.0).contains(&a.0[0]) && (60.0..240.0).contains(&a.0[1]), "{agent}: {a:?}");
            let high = Camera::following(agent, [0.0, 0.0, 5.0], [480, 360]).project([0.0, 0.0, 5.0]).unwrap().0;
            assert!((0.0..180.0).contains(&high[1]), "{agent} stays in the picture: {high:?}");
        }
        let aside = Camera::following(Agent::Ant, [0.0, 8.0, 0.6], [480, 360]);
        assert!((aside.project([0.0, 8.0, 0.6]).unwrap().0[0] - 240.0).abs() < 1e-9);
    }
}
