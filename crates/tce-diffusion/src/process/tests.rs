use super::*;

fn all() -> [Process; 3] {
    [Process::Ve(Ve::default()), Process::Vp(Vp::default()), Process::Edm(Edm::default())]
}

#[test]
fn the_schedule_is_appendix_b() {
    let (ve, vp) = (Process::Ve(Ve::default()), Process::Vp(Vp::default()));
    for tau in [1e-5f64, 0.1, 0.5, 1.0] {
        let b = 0.1 * tau + 0.5 * 19.9 * tau * tau;
        assert!((ve.level(tau).sigma - (1.0 - (-b).exp()).sqrt()).abs() < 1e-9);
        let l = vp.level(tau);
        assert!((l.alpha * l.alpha + l.sigma * l.sigma - 1.0).abs() < 1e-12);
        assert_eq!(l.sigma, ve.level(tau).sigma);
        // g² = dσ²/dτ by differences.
        let h = tau * 1e-4;
        let slope = (ve.level(tau + h).sigma.powi(2) - ve.level(tau - h).sigma.powi(2)) / (2.0 * h);
        let to = Level { tau: tau - 1e-3, ..ve.level(tau) };
        let g2 = ve.increment(ve.level(tau), to).variance / 1e-3;
        assert!((g2 - slope).abs() < 1e-5 * slope.max(1.0), "tau {tau}: {g2} {slope}");
    }
}

#[test]
fn levels_invert_their_ratio() {
    for p in all() {
        for tau in [p.end(), 0.01, 0.3, 0.7] {
            // Beyond that σ of VE is 1 to within the last digits.
            let l = p.level(tau);
            let back = p.level_of_ratio(l.ratio());
            assert!((back.tau - tau).abs() < 1e-9 * tau.max(1.0), "{p:?} {tau} {back:?}");
        }
    }
}

#[test]
fn grids_fall_from_the_start_to_the_end() {
    for p in all() {
        for grid in [p.uniform_grid(20), p.ratio_grid(20, Grid::Karras), p.ratio_grid(20, Grid::Log)] {
            let (first, last) = (grid[0], grid[grid.len() - 1]);
            let capped = matches!(p, Process::Vp(_)) && (first.ratio() - 20.0).abs() < 1e-9;
            assert!(first == p.level(1.0) || capped, "{p:?} {first:?}");
            assert!((last.sigma / p.level(p.end()).sigma - 1.0).abs() < 1e-6, "{p:?} {last:?}");
            assert!(grid.windows(2).all(|w| w[0].log_snr() < w[1].log_snr()));
        }
    }
    // EDM's two grids are one rule.
    let p = Process::Edm(Edm::default());
    for (a, b) in p.uniform_grid(19).iter().zip(p.ratio_grid(20, Grid::Karras)) {
        assert!((a.sigma / b.sigma - 1.0).abs() < 1e-9);
    }
}

/// The target makes the denoiser exact, and EDM's weight is theirs: λ(σ) c_out² = 1.
#[test]
fn preconditioning_is_consistent() {
    for p in all() {
        for tau in [p.end(), 0.2, 0.9] {
            let (l, x0, z) = (p.level(tau), 0.7, -1.3);
            let (c, (a, b)) = (p.precondition(l), p.network_target(l));
            let x = l.alpha * x0 + l.sigma * z;
            assert!((c.skip * x + c.out * (a * x0 + b * z) - x0).abs() < 1e-9, "{p:?} {tau}");
        }
    }
    let p = Process::Edm(Edm { sigma_data: 0.5, ..Edm::default() });
    let l = p.level_of_ratio(3.0);
    let weight = (9.0 + 0.25) / (3.0f64 * 0.5).powi(2);
    assert!((weight * p.precondition(l).out.powi(2) - 1.0).abs() < 1e-12);
}

#[test]
fn files_name_the_kind_and_refuse_unknown_fields() {
    let p: Process = serde_json::from_str(r#"{"kind":"edm","sigma_max":80}"#).unwrap();
    assert_eq!(p, Process::Edm(Edm { sigma_max: 80.0, ..Edm::default() }));
    assert!(serde_json::from_str::<Process>(r#"{"kind":"vp","sigma_max":80}"#).is_err());
    let p: Process = serde_json::from_str(r#"{"kind":"ve","start":"data"}"#).unwrap();
    assert!(p.starts_at_data());
    let error = Process::Vp(Vp { tau_min: 0.0, ..Vp::default() }).check().unwrap_err().to_string();
    assert_eq!(error, "process.tau_min: found 0, expected a time between 0 and 0.1");
}
