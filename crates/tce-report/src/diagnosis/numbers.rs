//! Numbers as they are printed.

use crate::svg::minus;

/// With as many decimals as its size asks for.
pub(super) fn number(value: f64) -> String {
    let text = match value.abs() {
        0.0 => "0".into(),
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 1.0 => format!("{value:.2}"),
        v if v >= 0.001 => format!("{value:.3}"),
        _ => format!("{value:.1e}"),
    };
    minus(text)
}

/// A setting as it was written.
pub(super) fn plain(value: f64) -> String {
    minus(format!("{value}"))
}
