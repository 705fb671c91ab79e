//! Scores over a setting (Fig. 4, Table G.1): where a sweep's overrides are called NAME=NUMBER, they are points of a line.

use std::collections::BTreeMap;

use maud::{Markup, html};

use crate::analysis::Analysis;
use crate::html::parts::task_caption;
use crate::html::words::term;
use crate::study::{Method, Study};
use crate::svg::{self, Axis, Frame, Line, Point, Scale, Series};

/// Fewer values than this make no curve.
const FEWEST: usize = 3;

/// A setting that was varied for one variant: the methods by the setting's value.
#[derive(Debug, PartialEq)]
pub struct Varied {
    /// The setting's name.
    pub name: String,
    /// In print, without the setting.
    pub title: String,
    /// Value and place among the methods, ascending.
    pub values: Vec<(f64, usize)>,
}

/// NAME and NUMBER of a method's override.
fn setting(method: &Method) -> Option<(&str, f64)> {
    let (name, number) = method.id.strip_prefix(&method.variant)?.trim().split_once('=')?;
    Some((name.trim(), number.trim().parse().ok().filter(|v: &f64| v.is_finite())?))
}

/// Everything that was varied.
pub fn varied(methods: &[Method]) -> Vec<Varied> {
    let mut found: BTreeMap<(String, String), Vec<(f64, usize)>> = BTreeMap::new();
    for (m, method) in methods.iter().enumerate() {
        if let Some((name, value)) = setting(method) {
            found.entry((name.to_owned(), method.variant.clone())).or_default().push((value, m));
        }
    }
    let curve = |((name, _), mut values): ((String, String), Vec<(f64, usize)>)| {
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Method { id, title, variant, .. } = &methods[values[0].1];
        let label = id.strip_prefix(variant.as_str()).unwrap_or_default().trim();
        let title = title.strip_suffix(label).map_or(title.as_str(), |t| t.trim_end_matches([',', ' '])).to_owned();
        (values.len() >= FEWEST).then_some(Varied { name, title, values })
    };
    found.into_iter().filter_map(curve).collect()
}

/// One figure per setting and task, with a line per method; None where nothing was varied.
pub fn section(study: &Study, analysis: &Analysis) -> Option<Markup> {
    let all = varied(&study.methods);
    if all.is_empty() {
        return None;
    }
    let mut names: Vec<&str> = all.iter().map(|v| v.name.as_str()).collect();
    names.dedup();
    let series: Vec<Series> = (all.iter().enumerate())
        .map(|(k, v)| Series { title: v.title.clone(), class: format!("m{}", k % 8) })
        .collect();
    let lines = |name: &str, row: &crate::analysis::Row| -> Vec<Line> {
        let of = |(k, v): (usize, &Varied)| {
            let point = |&(x, m): &(f64, usize)| {
                let cell = row.cells[m].as_ref()?;
                Some(Point { x, y: cell.mean, band: cell.std.map(|s| (cell.mean - s, cell.mean + s)) })
            };
            let points: Vec<Point> = v.values.iter().filter_map(point).collect();
            (v.name == name && !points.is_empty()).then(|| Line { series: series[k].clone(), points })
        };
        all.iter().enumerate().filter_map(of).collect()
    };
    Some(html! {
        p {
            "Scores when one setting is varied and the others stay. Lines are means over seeds, bands one standard deviation. Among the \
             settings: " (term("y", "y_max")) ", " (term("filter", "z_th")) ", " (term("lambda", "λ")) "."
        }
        @for name in names {
            h3 { (name) }
            div class="keys" { @for (s, v) in series.iter().zip(&all) { @if v.name == name { (svg::key(s)) } } }
            div class="panels small" {
                @for row in analysis.tables.iter().flat_map(|t| &t.rows) {
                    @let lines = lines(name, row);
                    @if !lines.is_empty() {
                        @let xs = || lines.iter().flat_map(|l| &l.points).map(|p| p.x);
                        @let ys = || lines.iter().flat_map(|l| &l.points).flat_map(|p| [p.range().0, p.range().1]);
                        figure {
                            (task_caption(analysis, &row.task))
                            (svg::lines(&Frame {
                                label: &format!("score over {name}, {}", row.task),
                                size: (320.0, 210.0),
                                x: (name, Axis::within(xs(), 5)),
                                y: ("normalised score", Axis::around(ys(), 4)),
                                scale: Scale::Linear,
                            }, &lines))
                        }
                    }
                }
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overrides_with_a_number_are_points_of_a_line() {
        let method = |variant: &str, label: &str| Method {
            id: format!("{variant} {label}").trim().into(),
            title: if label.is_empty() { "TCE(OG)".into() } else { format!("TCE(OG), {label}") },
            variant: variant.into(),
            base: variant.into(),
            published: false,
            baseline: false,
            plain: label.is_empty(),
        };
        let methods = [
            method("tce-og", ""),
            method("tce-og", "y_max=0.5"),
            method("tce-og", "y_max=0.1"),
            method("tce-og", "y_max=0.2"),
            method("tce-nn", "y_max=0.2"),
            method("tce-og", "z_th=strict"),
        ];
        let found = varied(&methods);
        let values = vec![(0.1, 2), (0.2, 3), (0.5, 1)];
        assert_eq!(found, [Varied { name: "y_max".into(), title: "TCE(OG)".into(), values }]);
    }
}
