//! Counts, rates and durations as people read them.

/// `1,000,000`.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// `2,213/s`, `4.2/s`, and below one a second `12.5/min` or `3.0/h`; `-` where nothing was done.
pub fn rate(per_second: f64) -> String {
    match per_second {
        r if !(r.is_finite() && r > 0.0) => "-".into(),
        r if r >= 9.95 => format!("{}/s", count(r.round() as u64)),
        r if r >= 1.0 => format!("{r:.1}/s"),
        r if r >= 1.0 / 60.0 => format!("{:.1}/min", r * 60.0),
        r => format!("{:.1}/h", r * 3600.0),
    }
}

/// `3.2 s`, `2 min 05 s`, `2.0 h`.
pub fn duration(seconds: f64) -> String {
    // Rounded first: 59.97 s is a minute, not "60.0 s".
    match seconds.max(0.0) {
        s if (s * 10.0).round() < 600.0 => format!("{s:.1} s"),
        s if s < 5400.0 => format!("{} min {:02} s", s.round() as u64 / 60, s.round() as u64 % 60),
        s => format!("{:.1} h", s / 3600.0),
    }
}

/// What is left of long work, no more exact than such an estimate is: `less than a minute`, `about 4 min`, `about 2.5 h`.
pub fn about(seconds: f64) -> String {
    match seconds {
        s if s < 50.0 => "less than a minute".into(),
        s if s < 5400.0 => format!("about {:.0} min", (s / 60.0).ceil()),
        s => format!("about {:.1} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_have_their_thousands_apart() {
        let counts = [0, 7, 999, 1_000, 12_345, 999_999, 1_000_000].map(count);
        assert_eq!(counts, ["0", "7", "999", "1,000", "12,345", "999,999", "1,000,000"]);
    }

    #[test]
    fn rates_are_never_nought() {
        let rates = [2213.4, 9.96, 9.94, 1.0, 0.5, 0.02, 0.01, 0.0, f64::INFINITY].map(rate);
        assert_eq!(rates, ["2,213/s", "10/s", "9.9/s", "1.0/s", "30.0/min", "1.2/min", "36.0/h", "-", "-"]);
    }

    #[test]
    fn durations_read_well() {
        let durations = [3.25, 59.94, 59.97, 125.0, 119.6, 7200.0].map(duration);
        assert_eq!(durations, ["3.2 s", "59.9 s", "1 min 00 s", "2 min 05 s", "2 min 00 s", "2.0 h"]);
        let left = [20.0, 50.0, 61.0, 240.0, 9000.0].map(about);
        assert_eq!(left, ["less than a minute", "about 1 min", "about 2 min", "about 4 min", "about 2.5 h"]);
    }
}
