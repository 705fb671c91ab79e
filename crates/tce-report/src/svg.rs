//! Figures as inline SVG. Colours are the page's variables, so that a figure follows light and dark; sizes are chosen so that
//! a panel is readable at a phone's width. Every mark has a `<title>`, which browsers show under the pointer.

use maud::{Markup, html};

use crate::stats::Estimate;

/// A line or a row: its name and the class that gives it its colour and dashes.
#[derive(Clone, Debug)]
pub struct Series {
    /// In print.
    pub title: String,
    /// `m0`, `f2`, ...
    pub class: String,
}

/// A row of [`intervals`].
#[derive(Clone, Debug)]
pub struct Interval {
    /// What it is of.
    pub series: Series,
    /// The dot and the thick line.
    pub inner: Estimate,
    /// The thin line.
    pub outer: Option<(f64, f64)>,
}

/// An axis: where it begins and ends, and its ticks.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    low: f64,
    high: f64,
    ticks: Vec<f64>,
}

impl Axis {
    /// An axis with about `n` round ticks that holds `values`; numbers that are not finite are not looked at.
    pub fn around(values: impl IntoIterator<Item = f64>, n: usize) -> Self {
        let finite = values.into_iter().filter(|v| v.is_finite());
        let (low, high) = finite.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = match (low > high, high - low < 1e-9 * high.abs().max(1.0)) {
            (true, _) => (0.0, 1.0),
            (_, true) => (low - 1.0, high + 1.0),
            _ => (low, high),
        };
        let raw = (high - low) / n.max(1) as f64;
        let magnitude = 10f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 2.5, 5.0, 10.0].map(|s| s * magnitude).into_iter().find(|s| *s >= raw * 0.999);
        let step = step.unwrap_or(10.0 * magnitude);
        let (first, last) = ((low / step).floor(), (high / step).ceil());
        let count = (last - first).round().clamp(1.0, 40.0) as usize;
        let ticks: Vec<f64> = (0..=count).map(|k| (first + k as f64) * step).collect();
        Self { low: ticks[0], high: ticks[count], ticks }
    }

    /// An axis that ends where `values` end, with the round ticks in between.
    pub fn within(values: impl IntoIterator<Item = f64>, n: usize) -> Self {
        let values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let mut axis = Self::around(values, n);
        if high > low {
            axis.ticks.retain(|t| (low..=high).contains(t));
            (axis.low, axis.high) = (low, high);
        }
        axis
    }

    /// From `low` to `high` with the given ticks.
    pub fn fixed(low: f64, high: f64, ticks: &[f64]) -> Self {
        Self { low, high, ticks: ticks.to_vec() }
    }

    fn place(&self, value: f64, from: f64, to: f64) -> f64 {
        from + (value - self.low) / (self.high - self.low) * (to - from)
    }

    fn label(&self, value: f64) -> String {
        let step = self.ticks.get(1).map_or(1.0, |t| (t - self.ticks[0]).abs());
        let decimals = if step >= 0.999 && step.fract() < 1e-9 { 0 } else { (-step.log10().floor()).max(1.0) as usize };
        // A step of 2.5 has one more digit than its magnitude says.
        let decimals =
            if step < 0.999 && (step * 10f64.powi(decimals as i32)).fract() > 1e-6 { decimals + 1 } else { decimals };
        match value.abs() {
            v if v >= 1e6 => format!("{:.3e}", value),
            v if v >= 10_000.0 => format!("{}k", (value / 1000.0 * 10.0).round() / 10.0),
            v if v < 1e-12 => "0".into(),
            _ => minus(format!("{value:.decimals$}")),
        }
    }
}

/// A number with a minus sign instead of a hyphen.
pub fn minus(text: String) -> String {
    text.replacen('-', "−", 1)
}

fn n(value: f64) -> String {
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

/// At most `most` characters, an ellipsis in the middle where some had to go: what tells long names apart is often at their end.
fn short(text: &str, most: usize) -> String {
    let count = text.chars().count();
    if count <= most {
        return text.to_owned();
    }
    let (first, last) = (most / 2, most - most / 2 - 1);
    text.chars().take(first).chain(['…']).chain(text.chars().skip(count - last)).collect()
}

/// Dots with intervals, one row each; `mark` is a value to compare with, drawn as a dashed line. Names stand before their rows, or above them
/// where one of them is too long for that.
pub fn intervals(
    label: &str,
    rows: &[Interval],
    axis: &Axis,
    unit: &str,
    mark: Option<f64>,
    decimals: usize,
) -> Markup {
    const WIDTH: f64 = 400.0;
    let above = rows.iter().any(|row| row.series.title.chars().count() > 20);
    // Height of a row, place of its dot in it, left end of the axis.
    let (high, dot, left) = if above { (40.0, 28.0, 8.0) } else { (25.0, 12.5, 138.0) };
    let (right, top) = (WIDTH - 46.0, 8.0);
    let bottom = top + high * rows.len() as f64;
    let height = bottom + 40.0;
    let x = |v: f64| axis.place(v.clamp(axis.low, axis.high), left, right);
    html! {
        svg viewBox=(format!("0 0 {} {}", n(WIDTH), n(height))) role="img" aria-label=(label) class="fig" {
            @for tick in &axis.ticks {
                line class="grid" x1=(n(x(*tick))) x2=(n(x(*tick))) y1=(n(top)) y2=(n(bottom)) {}
                text class="tick" x=(n(x(*tick))) y=(n(bottom + 15.0)) text-anchor="middle" { (axis.label(*tick)) }
            }
            line class="axis" x1=(n(left)) x2=(n(right)) y1=(n(bottom)) y2=(n(bottom)) {}
            @if let Some(mark) = mark {
                line class="ref" x1=(n(x(mark))) x2=(n(x(mark))) y1=(n(top)) y2=(n(bottom)) {}
            }
            @for (k, row) in rows.iter().enumerate() {
                @let y = top + high * k as f64 + dot;
                g class=(format!("mark {}", row.series.class)) {
                    title { (row.series.title) ": " (minus(row.inner.told(decimals))) }
                    @if above {
                        text class="name" x=(n(left)) y=(n(y - 13.0)) { (short(&row.series.title, 60)) }
                    } @else {
                        text class="name" x=(n(left - 10.0)) y=(n(y + 4.0)) text-anchor="end" { (row.series.title) }
                    }
                    @if let Some((low, high)) = row.outer {
                        line class="thin" x1=(n(x(low))) x2=(n(x(high))) y1=(n(y)) y2=(n(y)) {}
                    }
                    @if let Some((low, high)) = row.inner.interval {
                        line class="thick" x1=(n(x(low))) x2=(n(x(high))) y1=(n(y)) y2=(n(y)) {}
                    }
                    circle cx=(n(x(row.inner.point))) cy=(n(y)) r="3.6" {}
                    text class="value" x=(n(WIDTH - 2.0)) y=(n(y + 4.0)) text-anchor="end" {
                        (minus(format!("{:.decimals$}", row.inner.point)))
                    }
                }
            }
            text class="unit" x=(n((left + right) / 2.0)) y=(n(height - 6.0)) text-anchor="middle" { (unit) }
        }
    }
}

/// A point of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Its place.
    pub x: f64,
    /// Its value.
    pub y: f64,
    /// The band around the value.
    pub band: Option<(f64, f64)>,
}

impl Point {
    /// The ends of the band, or the value twice.
    pub fn range(&self) -> (f64, f64) {
        self.band.unwrap_or((self.y, self.y))
    }
}

/// A line with its band.
#[derive(Clone, Debug)]
pub struct Line {
    /// What it is of.
    pub series: Series,
    /// In ascending order of places.
    pub points: Vec<Point>,
}

/// What the values of an axis are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// The values themselves.
    Linear,
    /// Their decimal logarithms.
    Log,
}

/// Size and words of a [`lines`] figure.
#[derive(Clone, Debug)]
pub struct Frame<'a> {
    /// For those who cannot see it.
    pub label: &'a str,
    /// Width and height in units of the page's pixels at full size.
    pub size: (f64, f64),
    /// Below the horizontal axis.
    pub x: (&'a str, Axis),
    /// Above the vertical axis.
    pub y: (&'a str, Axis),
    /// What values of the vertical axis are.
    pub scale: Scale,
}

/// Lines with bands. A line of one point is a dot.
pub fn lines(frame: &Frame<'_>, lines: &[Line]) -> Markup {
    marked_lines(frame, lines, None)
}

/// [`lines`] with a place on the horizontal axis to compare with.
fn marked_lines(frame: &Frame<'_>, lines: &[Line], mark: Option<f64>) -> Markup {
    let (width, height) = frame.size;
    let (left, right, top, bottom) = (44.0, width - 12.0, 24.0, height - 40.0);
    let ((x_unit, x_axis), (y_unit, y_axis)) = (&frame.x, &frame.y);
    let x = |v: f64| x_axis.place(v, left, right);
    let y = |v: f64| y_axis.place(v.clamp(y_axis.low, y_axis.high), bottom, top);
    let y_label = |v: f64| if frame.scale == Scale::Log { power(v) } else { y_axis.label(v) };
    let path = |points: &mut dyn Iterator<Item = (f64, f64)>| -> String {
        points.map(|(a, b)| format!("{},{}", n(x(a)), n(y(b)))).collect::<Vec<_>>().join(" ")
    };
    let band = |line: &Line| -> Option<String> {
        let bands: Vec<(f64, (f64, f64))> = line.points.iter().filter_map(|p| Some((p.x, p.band?))).collect();
        let there = bands.iter().map(|b| (b.0, b.1.1));
        (bands.len() > 1).then(|| path(&mut there.chain(bands.iter().rev().map(|b| (b.0, b.1.0)))))
    };
    html! {
        svg viewBox=(format!("0 0 {} {}", n(width), n(height))) role="img" aria-label=(frame.label) class="fig" {
            @for tick in &y_axis.ticks {
                line class="grid" x1=(n(left)) x2=(n(right)) y1=(n(y(*tick))) y2=(n(y(*tick))) {}
                text class="tick" x=(n(left - 7.0)) y=(n(y(*tick) + 4.0)) text-anchor="end" { (y_label(*tick)) }
            }
            @for tick in &x_axis.ticks {
                line class="stub" x1=(n(x(*tick))) x2=(n(x(*tick))) y1=(n(bottom)) y2=(n(bottom + 4.0)) {}
                text class="tick" x=(n(x(*tick))) y=(n(bottom + 17.0)) text-anchor="middle" { (x_axis.label(*tick)) }
            }
            line class="axis" x1=(n(left)) x2=(n(right)) y1=(n(bottom)) y2=(n(bottom)) {}
            @if let Some(mark) = mark {
                line class="ref" x1=(n(x(mark))) x2=(n(x(mark))) y1=(n(top)) y2=(n(bottom)) {}
            }
            text class="unit" x="2" y="12" { (y_unit) }
            text class="unit" x=(n((left + right) / 2.0)) y=(n(height - 6.0)) text-anchor="middle" { (x_unit) }
            @for line in lines {
                @if let Some(points) = band(line) {
                    polygon class=(format!("band {}", line.series.class)) points=(points) {}
                }
            }
            @for line in lines {
                g class=(format!("mark {}", line.series.class)) {
                    title { (line.series.title) }
                    @if let [only] = line.points[..] {
                        circle cx=(n(x(only.x))) cy=(n(y(only.y))) r="3.5" {}
                    } @else {
                        polyline class="line" points=(path(&mut line.points.iter().map(|p| (p.x, p.y)))) {}
                    }
                }
            }
        }
    }
}

/// Points of one group.
#[derive(Clone, Debug)]
pub struct Cloud {
    /// What they are of.
    pub series: Series,
    /// Their places.
    pub points: Vec<[f32; 2]>,
}

/// Clouds of points on one scale in both directions, without axes: only what lies near what has a meaning.
pub fn clouds(label: &str, (width, height): (f64, f64), clouds: &[Cloud]) -> Markup {
    let all = || clouds.iter().flat_map(|c| &c.points).filter(|p| p[0].is_finite() && p[1].is_finite());
    let range =
        |k: usize| all().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(f64::from(p[k])), h.max(f64::from(p[k]))));
    let ((x0, x1), (y0, y1)) = (range(0), range(1));
    let margin = 6.0;
    let scale = ((width - 2.0 * margin) / (x1 - x0).max(1e-9)).min((height - 2.0 * margin) / (y1 - y0).max(1e-9));
    let place = |p: &[f32; 2]| {
        let x = width / 2.0 + (f64::from(p[0]) - (x0 + x1) / 2.0) * scale;
        let y = height / 2.0 - (f64::from(p[1]) - (y0 + y1) / 2.0) * scale;
        format!("M{} {}h0", n(x), n(y))
    };
    html! {
        svg viewBox=(format!("0 0 {} {}", n(width), n(height))) role="img" aria-label=(label) class="fig" {
            @for cloud in clouds {
                // One path a group: a circle a point would take ten times the bytes.
                path class=(format!("dots {}", cloud.series.class)) d=(cloud.points.iter().map(place).collect::<String>()) {
                    title { (cloud.series.title) }
                }
            }
        }
    }
}

/// The sample of a cloud beside its name.
pub fn dot_key(series: &Series) -> Markup {
    html! {
        span class="key" {
            svg class=(format!("sample dot {}", series.class)) viewBox="0 0 10 10" aria-hidden="true" { path class="dots" d="M5 5h0" {} }
            (series.title)
        }
    }
}

/// A histogram.
#[derive(Clone, Debug)]
pub struct Steps {
    /// What it is of.
    pub series: Series,
    /// Where the first bin begins.
    pub low: f64,
    /// Where the last one ends.
    pub high: f64,
    /// By bin.
    pub counts: Vec<u64>,
}

impl Steps {
    /// The share of every bin.
    pub fn shares(&self) -> Vec<f64> {
        let all = self.counts.iter().sum::<u64>().max(1) as f64;
        self.counts.iter().map(|c| *c as f64 / all).collect()
    }
}

/// Histograms as outlines; `mark` is a place to compare with.
pub fn steps(frame: &Frame<'_>, histograms: &[Steps], mark: Option<f64>) -> Markup {
    let outline = |h: &Steps| {
        let (shares, width) = (h.shares(), (h.high - h.low) / h.counts.len() as f64);
        let edge = |k: usize| h.low + k as f64 * width;
        let tops = (shares.iter().enumerate()).flat_map(|(k, y)| [(edge(k), *y), (edge(k + 1), *y)]);
        let points = std::iter::once((h.low, 0.0)).chain(tops).chain([(h.high, 0.0)]);
        Line { series: h.series.clone(), points: points.map(|(x, y)| Point { x, y, band: None }).collect() }
    };
    marked_lines(frame, &histograms.iter().map(outline).collect::<Vec<_>>(), mark)
}

/// A power of ten in print.
fn power(exponent: f64) -> String {
    match exponent.fract().abs() < 1e-9 {
        true => match exponent.round() as i64 {
            k @ -4..=3 => format!("{}", 10f64.powi(k as i32)),
            k => minus(format!("1e{k}")),
        },
        false => String::new(),
    }
}

/// The sample of a series beside its name.
pub fn key(series: &Series) -> Markup {
    html! {
        span class="key" {
            svg class=(format!("sample {}", series.class)) viewBox="0 0 26 10" aria-hidden="true" {
                line class="line" x1="1" x2="25" y1="5" y2="5" {}
            }
            (series.title)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_hold_all_values() {
        let axis = Axis::around([3.2, 97.0], 5);
        assert_eq!((axis.low, axis.high), (0.0, 100.0));
        assert_eq!(axis.ticks, [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]);
        let axis = Axis::around([0.43, 0.71], 4);
        assert!(axis.low <= 0.43 && axis.high >= 0.71 && axis.ticks.len() <= 6, "{axis:?}");
        assert_eq!(Axis::around([0.0, 50_000.0], 4).label(50_000.0), "50k");
        assert_eq!(Axis::around([-20.0, 20.0], 4).label(-20.0), "−20");
        for odd in [vec![], vec![f64::NAN], vec![5.0], vec![0.0, 0.0], vec![-1e300, 1e300]] {
            let axis = Axis::around(odd, 4);
            assert!(axis.low < axis.high && axis.ticks.len() >= 2, "{axis:?}");
        }
    }

    #[test]
    fn quarter_steps_keep_their_digits() {
        let axis = Axis::around([0.0, 1.0], 4);
        assert_eq!(
            axis.ticks.iter().map(|t| axis.label(*t)).collect::<Vec<_>>(),
            ["0", "0.25", "0.50", "0.75", "1.00"]
        );
    }
}
