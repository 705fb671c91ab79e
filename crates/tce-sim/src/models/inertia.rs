//! Mass properties, as MuJoCo 2.1.0 and older computed them.
//!
//! The public data were made with such a version. It gave a capsule of radius r and cylinder length L the mass and
//! inertia of a *cylinder* of radius r and length h = L + r (later versions use the exact capsule). The models
//! therefore specify their inertia explicitly. Otherwise replayed transitions are wrong by 0.002 to 0.17.

use super::robot::{Body, Geom, Robot, Shape, Vec3};

/// Mass (kg), centre of mass (m) and inertia about it (kg m^2), in the body's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MassProperties {
    /// Mass.
    pub mass: f64,
    /// Centre of mass.
    pub centre: Vec3,
    /// Inertia tensor about the centre of mass.
    pub inertia: [[f64; 3]; 3],
}

pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn minus(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// `perpendicular` (1 - u u^T) + `axial` u u^T, for a unit vector u.
fn symmetric_about(u: Vec3, perpendicular: f64, axial: f64) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let identity = if i == j { perpendicular } else { 0.0 };
            identity + (axial - perpendicular) * u[i] * u[j]
        })
    })
}

/// Mass properties of one geom of the given density: of a sphere, or of the cylinder that replaces a capsule.
pub fn of_geom(geom: &Geom, density: f64) -> MassProperties {
    let r = geom.radius;
    let (length, centre, axis) = match geom.shape {
        Shape::Sphere => {
            let mass = density * 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
            let inertia = symmetric_about([0.0, 0.0, 1.0], 0.4 * mass * r * r, 0.4 * mass * r * r);
            return MassProperties { mass, centre: [0.0; 3], inertia };
        }
        Shape::Segment { from, to } => {
            let along = minus(to, from);
            let length = dot(along, along).sqrt();
            (length, std::array::from_fn(|i| (from[i] + to[i]) / 2.0), along.map(|x| x / length))
        }
        Shape::Tilted { centre, half_length, tilt } => (2.0 * half_length, centre, [tilt.sin(), 0.0, tilt.cos()]),
    };
    let h = length + r;
    let mass = density * std::f64::consts::PI * r * r * h;
    let inertia = symmetric_about(axis, mass * (3.0 * r * r + h * h) / 12.0, mass * r * r / 2.0);
    MassProperties { mass, centre, inertia }
}

/// Combined mass properties of a body's geoms (parallel-axis theorem).
pub fn of_body(body: &Body, density: f64) -> MassProperties {
    let parts: Vec<_> = body.geoms.iter().map(|g| of_geom(g, density)).collect();
    let mass = parts.iter().map(|p| p.mass).sum::<f64>();
    let centre: Vec3 = std::array::from_fn(|i| parts.iter().map(|p| p.mass * p.centre[i]).sum::<f64>() / mass);
    let inertia = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let moved = |p: &MassProperties| {
                let d = minus(p.centre, centre);
                let squared = if i == j { dot(d, d) } else { 0.0 };
                p.inertia[i][j] + p.mass * (squared - d[i] * d[j])
            };
            parts.iter().map(moved).sum::<f64>()
        })
    });
    MassProperties { mass, centre, inertia }
}

/// The factor for masses and inertias that gives the robot its total mass.
pub fn scale(robot: &Robot) -> f64 {
    let Some(total) = robot.total_mass else { return 1.0 };
    let mut mass = 0.0;
    robot.torso.visit(&mut |body| mass += of_body(body, robot.density).mass);
    total / mass
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: f64, expected: f64) {
        assert!((found - expected).abs() <= 1e-12 * expected.abs().max(1e-3), "{found} instead of {expected}");
    }

    #[test]
    fn a_capsule_is_a_cylinder_longer_by_its_radius() {
        // Hopper's torso by hand: r = .05, L = .4, h = .45, density 1000.
        // m = 1000 pi .0025 .45 = 1.125 pi; I_perp = m (.0075 + .2025) / 12 = m .0175; I_axial = m .00125.
        let p = of_geom(&Geom::segment("torso", 0.05, [0.0, 0.0, 0.2], [0.0, 0.0, -0.2]), 1000.0);
        close(p.mass, 1.125 * std::f64::consts::PI);
        close(p.inertia[0][0], p.mass * 0.0175);
        close(p.inertia[1][1], p.mass * 0.0175);
        close(p.inertia[2][2], p.mass * 0.00125);
        assert_eq!(p.centre, [0.0; 3]);
        assert_eq!(p.inertia[0][1], 0.0);
    }

    #[test]
    fn a_sphere_is_a_sphere() {
        // Ant's torso by hand: r = .25, density 5: m = 5 * 4/3 pi / 64 = .1041666.. pi; I = .4 m / 16 = .025 m.
        let p =
            of_geom(&Geom { name: "torso".into(), radius: 0.25, shape: Shape::Sphere, sliding_friction: None }, 5.0);
        close(p.mass, std::f64::consts::PI * 5.0 / 48.0);
        for i in 0..3 {
            close(p.inertia[i][i], 0.025 * p.mass);
        }
    }

    #[test]
    fn both_ways_to_place_a_capsule_agree() {
        // After a rotation by 90 degrees about y, the z axis points along x.
        let tilted = of_geom(&Geom::tilted("g", 0.1, 0.5, [0.3, 0.0, 0.0], std::f64::consts::FRAC_PI_2), 1.0);
        let segment = of_geom(&Geom::segment("g", 0.1, [-0.2, 0.0, 0.0], [0.8, 0.0, 0.0]), 1.0);
        close(tilted.mass, segment.mass);
        for i in 0..3 {
            assert!((tilted.centre[i] - segment.centre[i]).abs() < 1e-15);
            for j in 0..3 {
                assert!((tilted.inertia[i][j] - segment.inertia[i][j]).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn two_geoms_combine_by_the_parallel_axis_theorem() {
        // Two equal cylinders along x with centres at x = -1 and x = +1: the axial moment doubles, the other two
        // increase by 2 m d^2 with d = 1.
        let one = |x: f64| Geom::segment("g", 0.1, [x - 0.2, 0.0, 0.0], [x + 0.2, 0.0, 0.0]);
        let single = of_geom(&one(0.0), 10.0);
        let mut body = Body::new("b", [0.0; 3], one(-1.0));
        body.geoms.push(one(1.0));
        let both = of_body(&body, 10.0);
        close(both.mass, 2.0 * single.mass);
        close(both.inertia[0][0], 2.0 * single.inertia[0][0]);
        close(both.inertia[1][1], 2.0 * single.inertia[1][1] + 2.0 * single.mass);
        close(both.inertia[2][2], 2.0 * single.inertia[2][2] + 2.0 * single.mass);
        assert!(both.centre.iter().all(|c| c.abs() < 1e-15));
    }
}
