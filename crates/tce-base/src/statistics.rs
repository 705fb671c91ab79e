//! The mean and the spread of a few numbers, and how well the mean is known.

/// Mean and sample standard deviation (divisor n - 1); 0 and 0 of no values.
pub fn mean_std(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n.max(1.0);
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, variance.sqrt())
}

/// Mean and its standard error; 0 of a single value, whose spread is not known.
pub fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let (mean, std) = mean_std(values);
    (mean, std / (values.len().max(1) as f64).sqrt())
}

/// `61.7 ± 4.2`, or without the spread for one value.
pub fn plus_minus(values: &[f64]) -> String {
    let (mean, std) = mean_std(values);
    if values.is_empty() {
        return "-".to_owned();
    }
    if values.len() > 1 { format!("{mean:.1} ± {std:.1}") } else { format!("{mean:.1}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_those_of_a_sample() {
        assert_eq!(mean_std(&[1.0, 2.0, 3.0]), (2.0, 1.0));
        assert_eq!(mean_and_error(&[1.0, 3.0, 1.0, 3.0]), (2.0, (1.0f64 / 3.0).sqrt()));
        assert_eq!(mean_and_error(&[4.0]), (4.0, 0.0));
        assert_eq!(plus_minus(&[1.0, 2.0, 3.0]), "2.0 ± 1.0");
        assert_eq!(plus_minus(&[]), "-");
        assert_eq!(plus_minus(&[61.7]), "61.7");
    }
}
