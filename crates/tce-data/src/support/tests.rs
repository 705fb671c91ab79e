use proptest::prelude::*;
use rand::RngExt;
use tce_base::Streams;

use super::*;

/// Columns: continuous, clipped at ±10, clipped at the top only, 0.7, a flag, a quaternion (5..=8), continuous, cosine
/// and sine (10, 11).
const DIM: usize = 12;

fn table(seed: u64, rows: usize) -> Vec<f32> {
    let mut rng = Streams::new(seed).stream("rows");
    let mut out = Vec::new();
    for _ in 0..rows {
        let mut u = || rng.random_range(-1.0f32..1.0);
        let q = [1.0 + 0.3 * u(), 0.4 * u(), 0.4 * u(), u()];
        let norm = squared_norm(&q).sqrt() as f32;
        let angle = 0.1 * u();
        out.extend([3.0 * u(), (12.0 * u()).clamp(-10.0, 10.0), (7.0 * u()).min(6.5), 0.7, (u() > 0.0) as u8 as f32]);
        out.extend(q.map(|x| x / norm));
        out.extend([u(), angle.cos(), angle.sin()]);
    }
    out
}

#[test]
fn every_kind_is_found_and_nothing_else() {
    let (a, b) = (table(1, 5000), table(2, 3000));
    let s = Support::fit(&[&a, &b], DIM);
    assert_eq!((s.dim, s.rows), (DIM, 8000));
    assert_eq!(s.constants, [Constant { column: 3, value: 0.7 }]);
    assert_eq!(s.levels, [Levels { column: 4, values: vec![0.0, 1.0] }]);
    assert_eq!(s.units, [UnitGroup { first: 5, width: 4 }, UnitGroup { first: 10, width: 2 }]);
    let ends: Vec<_> = s.clips.iter().map(|c| (c.column, c.low.map(|b| b.value), c.high.map(|b| b.value))).collect();
    assert_eq!(ends, [(1, Some(-10.0), Some(10.0)), (2, None, Some(6.5))]);
    let told = s.describe();
    assert_eq!(told.len(), 6);
    assert_eq!(told[0], "Column 3 is always 0.7: put back to it.");
    assert_eq!(told[1], "Column 4 has only the values 0, 1: rounded to the nearest of them.");
    assert_eq!(told[2], "Columns 5 to 8 are a unit quaternion: normalised.");
    assert_eq!(told[3], "Columns 10 and 11 lie on the unit circle: normalised.");
    assert!(told[4].starts_with("Column 1 is clipped at -10 (8.") && told[4].contains(" and at 10 ("), "{}", told[4]);
    assert!(told[5].ends_with("clamped there."));
}

#[test]
fn rows_come_to_respect_it() {
    let s = Support::fit(&[&table(1, 5000)], DIM);
    let mut row = [9.0, 11.0, -20.0, 0.6, 0.4, 2.0, 0.0, 0.0, 0.0, 5.0, 0.3, 0.4];
    s.apply(&mut row);
    assert_eq!(row, [9.0, 10.0, -20.0, 0.7, 0.0, 1.0, 0.0, 0.0, 0.0, 5.0, 0.6, 0.8]);
    let mut row = [f32::NAN; DIM];
    s.apply(&mut row);
    assert_eq!(row.iter().filter(|x| x.is_nan()).count(), DIM - 1);
    let mut row = [0.0; DIM];
    s.apply(&mut row);
    assert_eq!(row[5..9], [0.0; 4]);
}

/// A rare clip counts if another column has the same bound; with a bound of its own it does not count.
#[test]
fn one_sensor_clips_all_its_columns_at_the_same_bound() {
    let mut rng = Streams::new(3).stream("rows");
    let mut rows: Vec<f32> = (0..5000)
        .flat_map(|_| {
            let mut u = || rng.random_range(-1.0f32..1.0);
            [(11.0 * u()).clamp(-10.0, 10.0), 9.0 * u(), 7.0 * u()]
        })
        .collect();
    (rows[1], rows[2], rows[5]) = (10.0, 8.0, 8.0);
    let s = Support::fit(&[&rows], 3);
    assert_eq!(s.clips.len(), 2);
    assert_eq!((s.clips[1].column, s.clips[1].low, s.clips[1].high), (1, None, Some(Bound { value: 10.0, rows: 1 })));
}

/// 20 of 5000 rows of one table are an atom, whatever the number of rows of the other table.
#[test]
fn a_large_table_does_not_hide_an_atom_of_a_small_one() {
    let mut rng = Streams::new(4).stream("rows");
    let mut small: Vec<f32> = (0..5000).map(|_| rng.random_range(-1.0..1.0)).collect();
    small[..20].fill(1.0);
    let large: Vec<f32> = (0..100_000).map(|_| rng.random_range(-1.0..0.9)).collect();
    let s = Support::fit(&[&large, &small], 1);
    assert_eq!(s.clips, [Clip { column: 0, low: None, high: Some(Bound { value: 1.0, rows: 20 }) }]);
    // The other table has values beyond the atom of this one, so it is not a bound.
    let wide: Vec<f32> = large.iter().map(|x| 2.0 * x).collect();
    assert!(Support::fit(&[&wide, &small], 1).is_empty());
}

#[test]
fn steps_counters_and_steady_columns_are_not_mistaken() {
    // Columns: a step counter in episodes of 20; values near 1 and near 0 (their norm is 1 by chance); a coarse sensor.
    let mut rng = Streams::new(5).stream("rows");
    let rows: Vec<f32> = (0..5000)
        .flat_map(|i| {
            let mut u = || rng.random_range(-1.0f32..1.0);
            [(i % 20) as f32, 1.0 + 3e-4 * u(), 0.01 * u(), (50.0 * u()).round() / 50.0]
        })
        .collect();
    assert!(Support::fit(&[&rows], 4).is_empty());
    // A circle beside a joint that hardly moves is not a quaternion; one-hot flags are not a circle.
    let rows: Vec<f32> = (0..5000)
        .flat_map(|i| {
            let mut u = || rng.random_range(-1.0f32..1.0);
            let angle = 3.0 * u();
            let flag = (i % 3 == 0) as u8 as f32;
            [angle.cos(), angle.sin(), 0.01 * u(), 0.01 * u(), flag, 1.0 - flag]
        })
        .collect();
    let s = Support::fit(&[&rows], 6);
    assert_eq!(s.units, [UnitGroup { first: 0, width: 2 }]);
    assert_eq!((s.levels.len(), s.clips.len()), (2, 0));
}

#[test]
fn little_or_broken_data_say_nothing() {
    assert!(Support::fit(&[], 3).is_empty());
    assert!(Support::fit(&[&[]], 0).is_empty());
    assert!(Support::fit(&[&[1.0; 99]], 1).is_empty());
    assert_eq!(Support::fit(&[&[1.0; 100]], 1).constants.len(), 1);
    let mut rows = [1.0; 100];
    rows[50] = f32::NAN;
    assert!(Support::fit(&[&rows], 1).is_empty());
    assert_eq!(Support::fit(&[&[0.0; 300]], 3).describe(), ["Columns 0 to 2 are always 0: put back to it."]);
}

#[test]
fn it_survives_json() {
    let s = Support::fit(&[&table(1, 5000)], DIM);
    let json = serde_json::to_string(&s).unwrap();
    assert_eq!(serde_json::from_str::<Support>(&json).unwrap(), s);
    assert!(serde_json::from_str::<Support>(&json.replace("clips", "clops")).is_err());
}

fn bits(rows: &[f32]) -> Vec<u32> {
    rows.iter().map(|x| x.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// For any numbers: a second application changes nothing, other columns keep their bytes, and bounds hold.
    #[test]
    fn applying_is_idempotent_and_touches_nothing_else(
        rows in prop::collection::vec(prop_oneof![-30f32..30.0, any::<f32>(), Just(-0.0f32), Just(10.0f32)], DIM * 20),
    ) {
        let s = Support::fit(&[&table(7, 2000)], DIM);
        let mut once = rows.clone();
        s.apply(&mut once);
        let mut twice = once.clone();
        s.apply(&mut twice);
        prop_assert_eq!(bits(&once), bits(&twice));
        for (before, after) in rows.chunks_exact(DIM).zip(once.chunks_exact(DIM)) {
            for free in [0, 9] {
                prop_assert_eq!(before[free].to_bits(), after[free].to_bits());
            }
            prop_assert!(after[1].is_nan() || after[1].abs() <= 10.0);
            prop_assert!(after[4].is_nan() || after[4] == 0.0 || after[4] == 1.0);
            let norm = squared_norm(&after[10..12]).sqrt();
            prop_assert!(!norm.is_finite() || norm == 0.0 || (norm - 1.0).abs() < 1e-6);
        }
    }

    /// The data's own rows do not change, and continuous columns of any scale give no finding.
    #[test]
    fn own_rows_stay_and_continuous_columns_are_free(seed in 0u64..1000, rows in 1000usize..3000) {
        let own = table(seed, rows);
        let s = Support::fit(&[&own], DIM);
        let mut after = own.clone();
        s.apply(&mut after);
        prop_assert_eq!(bits(&own), bits(&after));
        let mut rng = Streams::new(seed).stream("normal");
        let scale = 10f32.powi(rng.random_range(-6..6));
        let free: Vec<f32> = (0..3 * rows).map(|_| {
            let sum: f32 = (0..4).map(|_| rng.random_range(-1.0f32..1.0)).sum();
            5.0 * scale + scale * sum
        }).collect();
        prop_assert!(Support::fit(&[&free], 3).is_empty());
    }
}
