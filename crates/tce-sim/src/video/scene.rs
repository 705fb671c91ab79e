//! Renders capsules on a chequered floor by ray casting.
//!
//! The nearest surface along a ray is visible, decided separately for every sample point. So limbs that cross or meet
//! in a joint hide each other correctly, which painting whole limbs from back to front cannot achieve. Every pixel has
//! four sample points, so that edges are smooth.

use crate::models::inertia::{dot, minus};
use crate::models::robot::Vec3;

use super::camera::{Camera, Floor, along, unit};
use super::picture::{Colour, Picture, mix};
use super::solid::{Paint, Solid};

/// Sample points within a pixel, a rotated square: nearly horizontal or vertical edges cross them one after another.
const POINTS: [[f64; 2]; 4] = [[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
/// Direction towards the light: above, in front and to the left.
const LIGHT: Vec3 = [-0.35, -0.55, 0.9];
/// Number of shades of a surface. It is small, so that the colours of a GIF are enough for a video.
const SHADES: usize = 7;
/// Number of steps in which the floor fades into the sky.
const FADES: usize = 16;
/// Thickness of an outline, pixels.
const OUTLINE: f64 = 1.3;

pub(super) const SKY: Colour = [246, 248, 250];
const GROUND: [Colour; 2] = [[222, 227, 233], [205, 212, 220]];
const SHADOW: Colour = [60, 68, 82];

/// The colour of a paint in full light.
pub(super) fn colour(paint: Paint) -> Colour {
    // Okabe and Ito's blue, green and vermilion, which colour-blind people can also distinguish.
    match paint {
        Paint::Torso => [128, 138, 152],
        Paint::Right => [30, 136, 205],
        Paint::Left => [20, 170, 130],
        Paint::Changed => [235, 105, 30],
    }
}

/// Draws `solids` as seen by `camera`.
pub(super) fn draw(camera: &Camera, solids: &[Solid], floor: Floor, [width, height]: [usize; 2]) -> Picture {
    let mut samples = ground(camera, solids, floor, width, height);
    let mut depths = vec![f64::INFINITY; samples.len()];
    let light = unit(LIGHT);
    for solid in solids {
        let Some([columns, rows]) = bounds(camera, solid, width, height) else { continue };
        let shades = shades(solid.paint);
        let body = Seen::new(camera, solid, solid.radius);
        // One pixel larger: if a pixel's central ray misses it, the rays of all its sample points miss the solid.
        let around = Seen::new(camera, solid, solid.radius + 1.0 / body.scale);
        for y in rows {
            for x in columns.clone() {
                if around.hit(camera.ray(x as f64 + 0.5, y as f64 + 0.5)).is_none() {
                    continue;
                }
                for (k, [dx, dy]) in POINTS.into_iter().enumerate() {
                    let ray = camera.ray(x as f64 + dx, y as f64 + dy);
                    let Some(Hit { depth, normal, facing }) = body.hit(ray) else { continue };
                    let at = 4 * (y * width + x) + k;
                    // Limbs sink slightly below the ground in every step; that part stays hidden.
                    if depth < depths[at] && camera.position[2] + depth * ray[2] > -1e-3 {
                        depths[at] = depth;
                        // The outline is where the surface is almost parallel to the ray.
                        let lit = || 0.5 + 0.5 * dot(normal, light);
                        samples[at] = shades[if facing < body.rim { 0 } else { shade(lit()) }];
                    }
                }
            }
        }
    }
    let pixels = samples
        .chunks_exact(4)
        .map(|four| std::array::from_fn(|i| ((four.iter().map(|s| u16::from(s[i])).sum::<u16>() + 2) / 4) as u8));
    Picture { width, height, pixels: pixels.collect() }
}

/// The colours of a paint from the outline (0) to full light.
fn shades(paint: Paint) -> [Colour; SHADES] {
    let full = colour(paint);
    std::array::from_fn(|k| match k {
        0 => mix(full, [20, 24, 32], 0.62),
        k => mix(mix(full, [20, 24, 32], 0.45), mix(full, [255; 3], 0.22), (k - 1) as f64 / (SHADES - 2) as f64),
    })
}

/// The shade of a surface for its amount of light, from 0 to 1.
fn shade(lit: f64) -> usize {
    1 + ((lit * (SHADES - 1) as f64) as usize).min(SHADES - 2)
}

/// The point where a ray enters a solid.
struct Hit {
    /// Distance along the ray.
    depth: f64,
    /// The surface normal.
    normal: Vec3,
    /// The cosine of the angle between normal and ray. On the wall of a cylinder, the ray is projected along its axis;
    /// otherwise a cylinder that points at the camera would be all outline.
    facing: f64,
}

/// A solid relative to the camera's position.
struct Seen {
    /// Ends, relative to the camera.
    ends: [Vec3; 2],
    /// Unit vector from the first end to the second, and their distance; zero for spheres.
    axis: Vec3,
    length: f64,
    radius: f64,
    /// The value of `facing` at which the outline begins.
    rim: f64,
    /// Pixels per metre at the farther end.
    scale: f64,
}

impl Seen {
    fn new(camera: &Camera, solid: &Solid, radius: f64) -> Self {
        let ends = solid.ends.map(|end| minus(end, camera.position));
        let way = minus(ends[1], ends[0]);
        let length = dot(way, way).sqrt();
        let axis = if length > 0.0 { way.map(|x| x / length) } else { [0.0; 3] };
        let [a, b] = ends.map(|end| dot(end, end).sqrt());
        // On a round body of r pixels, the surface w pixels from its edge has the cosine sqrt(1 - (1 - w / r)^2).
        let inner = (1.0 - OUTLINE / (radius * camera.scale(a.min(b)))).max(0.5);
        Self { ends, axis, length, radius, rim: (1.0 - inner * inner).sqrt(), scale: camera.scale(a.max(b)) }
    }

    /// The point where a ray from the camera enters. A capsule is two spheres and the wall of a cylinder between them.
    fn hit(&self, ray: Vec3) -> Option<Hit> {
        let mut nearest: Option<Hit> = None;
        let mut offer = |depth: f64, centre: Vec3, gaze: Vec3| {
            if depth > 0.0 && nearest.as_ref().is_none_or(|before| depth < before.depth) {
                let out = minus(ray.map(|x| x * depth), centre);
                let normal = out.map(|x| x / self.radius);
                nearest = Some(Hit { depth, normal, facing: -dot(normal, gaze) / dot(gaze, gaze).sqrt() });
            }
        };
        for end in self.ends {
            if let Some(depth) = entry(ray, end, self.radius) {
                offer(depth, end, ray);
            }
            if self.length == 0.0 {
                return nearest;
            }
        }
        // Projected along its axis, the cylinder is a circle.
        let across = |v: Vec3| along(v, -dot(v, self.axis), self.axis);
        let gaze = across(ray);
        if let Some(depth) = entry(gaze, across(self.ends[0]), self.radius) {
            let height = depth * dot(ray, self.axis) - dot(self.ends[0], self.axis);
            if (0.0..=self.length).contains(&height) {
                offer(depth, along(self.ends[0], height, self.axis), gaze);
            }
        }
        nearest
    }
}

/// The smaller t for which `t ray` has the distance `radius` from `centre`.
fn entry(ray: Vec3, centre: Vec3, radius: f64) -> Option<f64> {
    let (a, b, c) = (dot(ray, ray), dot(ray, centre), dot(centre, centre) - radius * radius);
    let d = b * b - a * c;
    (d >= 0.0 && a > 1e-12).then(|| (b - d.sqrt()) / a)
}

/// The columns and rows of the picture in which a solid may be visible.
fn bounds(camera: &Camera, solid: &Solid, width: usize, height: usize) -> Option<[std::ops::Range<usize>; 2]> {
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for end in solid.ends {
        let (at, depth) = camera.project(end)?;
        // The outline of a sphere reaches beyond its radius at the centre's depth, by less than this.
        let reach = 1.5 * solid.radius * camera.scale((depth - solid.radius).max(0.1)) + 1.0;
        for i in 0..2 {
            low[i] = low[i].min(at[i] - reach);
            high[i] = high[i].max(at[i] + reach);
        }
    }
    let range = |i: usize, limit: usize| {
        let inside = |x: f64| x.clamp(0.0, limit as f64) as usize;
        inside(low[i])..inside(high[i].ceil())
    };
    let [columns, rows] = [range(0, width), range(1, height)];
    (!columns.is_empty() && !rows.is_empty()).then_some([columns, rows])
}

/// Draws sky and ground with four samples per pixel. Shadows fall straight down and so show how high a foot is.
///
/// The camera has no roll, so all ground points of a row have the same depth. Expensive values are computed once per
/// row.
fn ground(camera: &Camera, solids: &[Solid], floor: Floor, width: usize, height: usize) -> Vec<Colour> {
    // The two colours of squares, then both in the shadow.
    let tones: Vec<[Colour; 4]> = (0..=FADES)
        .map(|k| {
            std::array::from_fn(|i| {
                let tile = if i < 2 { GROUND[i] } else { mix(GROUND[i - 2], SHADOW, 0.35) };
                mix(tile, SKY, k as f64 / FADES as f64)
            })
        })
        .collect();
    let [low, high] = extent(solids);
    let mut samples = vec![SKY; 4 * width * height];
    for (y, row) in samples.chunks_exact_mut(4 * width).enumerate() {
        for (k, [dx, dy]) in POINTS.into_iter().enumerate() {
            let [first, next] = [0.0, 1.0].map(|x| camera.ray(x + dx, y as f64 + dy));
            if first[2] > -1e-3 {
                continue;
            }
            let depth = camera.position[2] / -first[2];
            let fade = ((depth - floor.fade) / 9.0).clamp(0.0, 1.0);
            let tones = &tones[(fade * FADES as f64).round() as usize];
            let start: [f64; 2] = std::array::from_fn(|i| camera.position[i] + depth * first[i]);
            let step: [f64; 2] = std::array::from_fn(|i| depth * (next[i] - first[i]));
            // A large even number of squares makes the value positive, so that truncation rounds down.
            let even = 2.0 * (1u64 << 24) as f64;
            for x in 0..width {
                let p: [f64; 2] = std::array::from_fn(|i| start[i] + x as f64 * step[i]);
                let [i, j] = p.map(|c| (c / floor.square + even) as i64);
                let near = (0..2).all(|i| low[i] < p[i] && p[i] < high[i]);
                let shaded = near && solids.iter().any(|solid| below(solid, p));
                row[4 * x + k] = tones[((i + j) & 1) as usize + 2 * usize::from(shaded)];
            }
        }
    }
    samples
}

/// The smallest and the largest x and y of some solids.
fn extent(solids: &[Solid]) -> [[f64; 2]; 2] {
    let mut out = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
    for (end, radius) in solids.iter().flat_map(|s| s.ends.map(|end| (end, s.radius))) {
        for i in 0..2 {
            out[0][i] = out[0][i].min(end[i] - radius);
            out[1][i] = out[1][i].max(end[i] + radius);
        }
    }
    out
}

/// Whether a solid is vertically above a point of the ground.
fn below(solid: &Solid, p: [f64; 2]) -> bool {
    let [a, b] = solid.ends;
    let (way, to) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let square = way[0] * way[0] + way[1] * way[1];
    let t = if square > 0.0 { ((way[0] * to[0] + way[1] * to[1]) / square).clamp(0.0, 1.0) } else { 0.0 };
    let off = [to[0] - t * way[0], to[1] - t * way[1]];
    off[0] * off[0] + off[1] * off[1] < solid.radius * solid.radius
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [160, 120];
    const FLOOR: Floor = Floor { square: 0.5, fade: 5.5 };

    /// A camera at a distance of 4 m, with 30 pixels per metre.
    fn camera() -> Camera {
        Camera::new([0.0, -4.0, 2.0], [0.0, 0.0, 2.0], 4.0, SIZE)
    }

    fn solid(from: Vec3, to: Vec3, radius: f64, paint: Paint) -> Solid {
        Solid { ends: [from, to], radius, paint }
    }

    /// The paint whose colours are nearest to that of a pixel; `None` for sky and ground.
    fn seen(picture: &Picture, x: usize, y: usize) -> Option<Paint> {
        let paints = [Paint::Torso, Paint::Right, Paint::Left, Paint::Changed].map(|p| (Some(p), shades(p).to_vec()));
        let behind = (None, vec![SKY, GROUND[0], GROUND[1]]);
        let distance = |c: &Colour| (0..3).map(|i| c[i].abs_diff(picture.pixel(x, y)[i]) as u32).sum::<u32>();
        let all = paints.into_iter().chain([behind]);
        all.min_by_key(|(_, colours)| colours.iter().map(distance).min()).unwrap().0
    }

    fn shows(picture: &Picture, x: usize, y: usize, paint: Paint) -> bool {
        seen(picture, x, y) == Some(paint)
    }

    #[test]
    fn a_capsule_covers_the_pixels_that_it_should() {
        // From 1 m left to 1 m right, 0.2 m thick: columns 50 to 110 and 6 more pixels per cap, rows 54 to 66.
        let bar = solid([-1.0, 0.0, 2.0], [1.0, 0.0, 2.0], 0.2, Paint::Left);
        let picture = draw(&camera(), &[bar], FLOOR, SIZE);
        let covered = |x, y| shows(&picture, x, y, Paint::Left);
        for x in 45..=114 {
            assert!(covered(x, 60), "column {x}");
        }
        for y in 55..=64 {
            assert!(covered(80, y), "row {y}");
        }
        for (x, y) in [(42, 60), (117, 60), (80, 52), (80, 67), (44, 55), (115, 65)] {
            assert!(!covered(x, y), "({x}, {y}) is outside");
        }
        let area = (0..SIZE[0] * SIZE[1]).filter(|k| covered(k % SIZE[0], k / SIZE[0])).count() as f64;
        // The area of a stadium: 60 by 12, and a circle of radius 6.
        let whole = 60.0 * 12.0 + std::f64::consts::PI * 36.0;
        assert!((0.9 * whole..1.1 * whole).contains(&area), "{area} of {whole}");
    }

    #[test]
    fn nearer_things_cover_farther_ones_in_any_order() {
        let far = solid([-1.0, 0.5, 2.0], [1.0, 0.5, 2.0], 0.2, Paint::Left);
        let near = solid([0.0, -0.5, 1.0], [0.0, -0.5, 3.0], 0.2, Paint::Right);
        let one = draw(&camera(), &[far, near], FLOOR, SIZE);
        assert!(one == draw(&camera(), &[near, far], FLOOR, SIZE));
        assert!(shows(&one, 80, 60, Paint::Right));
        assert!(shows(&one, 60, 60, Paint::Left) && shows(&one, 100, 60, Paint::Left));
        // Of a capsule that runs from in front of another one to behind it, half is hidden.
        let slanted = solid([-1.0, -1.0, 2.0], [1.0, 1.0, 2.0], 0.1, Paint::Changed);
        let post = solid([-0.5, 0.0, 2.0], [0.5, 0.0, 2.0], 0.1, Paint::Torso);
        let both = draw(&camera(), &[slanted, post], FLOOR, SIZE);
        assert!(shows(&both, 68, 60, Paint::Changed) && shows(&both, 92, 60, Paint::Torso));
    }

    #[test]
    fn a_ball_hides_what_is_within_it_and_stands_on_its_shadow() {
        let ball = solid([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 0.5, Paint::Torso);
        let core = solid([-0.2, 0.0, 1.0], [0.2, 0.0, 1.0], 0.1, Paint::Changed);
        let camera = Camera::new([0.0, -4.0, 3.0], [0.0, 0.0, 1.0], 4.0, SIZE);
        let picture = draw(&camera, &[core, ball], FLOOR, SIZE);
        assert!(picture == draw(&camera, &[ball], FLOOR, SIZE));
        let empty = draw(&camera, &[], FLOOR, SIZE);
        let ([x, y], _) = camera.project([0.0, -0.2, 0.0]).unwrap();
        let at = |p: &Picture| p.pixel(x as usize, y as usize).map(u32::from).iter().sum::<u32>();
        assert!(at(&picture) + 60 < at(&empty), "the ground below the ball is darker");
    }

    #[test]
    fn the_ground_moves_with_the_camera() {
        let seen = |x: f64| draw(&Camera::new([x, -4.0, 2.0], [x, 0.0, 0.5], 4.0, SIZE), &[], FLOOR, SIZE);
        assert!(seen(0.1) != seen(0.35));
        assert!(seen(0.1) == seen(0.1 + 1.0), "squares repeat");
    }
}
