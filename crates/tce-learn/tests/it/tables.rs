//! Compares the tables in doc comments with the actual values.

use serde_json::{Value, json};
use tce_learn::cvae::CvaeConfig;
use tce_learn::pair_model::PairConfig;
use tce_learn::sac::SacConfig;
use tce_learn::{
    ActorConfig, BcConfig, BosaConfig, DaraConfig, DmcConfig, DynamicsConfig, FittedQConfig, IgdfConfig, IqlConfig,
    LabelConfig, MetaDtConfig, OtdfConfig, RebracConfig, RegulariserConfig, SrpoConfig, Td3BcConfig,
};

/// The file of a table below `src/`, and the configuration that the table describes.
macro_rules! tables {
    ($($file:literal: $config:expr;)*) => {
        [$(($file, include_str!(concat!("../../src/", $file)), json!($config)),)*]
    };
}

/// Parses `.5`, `10 000`, `3e-4` or the end of `√(.4/4) = .316`, at the beginning of a cell or of one of its parts.
fn number(text: &str) -> Option<f64> {
    let text = text.rsplit('=').next()?.trim();
    let mut digits = String::new();
    for (i, c) in text.char_indices() {
        let next = text[i + c.len_utf8()..].chars().next();
        match c {
            '0'..='9' | '.' | 'e' | '-' => digits.push(c),
            ' ' if next.is_some_and(|n| n.is_ascii_digit()) => {}
            _ => break,
        }
    }
    digits.trim_end_matches('e').parse().ok()
}

/// Whether a cell agrees with `found`, a number or a list of numbers; `None` if it cannot be compared.
fn agrees(cell: &str, found: &Value) -> Option<bool> {
    let close = |a: f64, b: f64| (a - b).abs() <= 2e-3 * b.abs();
    match found {
        Value::Number(n) => Some(close(number(cell)?, n.as_f64()?)),
        Value::Array(list) => {
            let told: Vec<f64> = cell.split([',', '-']).map_while(number).collect();
            let list: Vec<f64> = list.iter().filter_map(Value::as_f64).collect();
            (!told.is_empty()).then(|| told == list)
        }
        _ => None,
    }
}

#[test]
fn tables_tell_the_values() {
    let (mut compared, mut wrong) = (0, Vec::new());
    for (file, text, config) in tables! {
        "algorithms/iql.rs": IqlConfig::paper();
        "algorithms/bc.rs": BcConfig::default();
        "algorithms/bosa.rs": BosaConfig::default();
        "algorithms/dara.rs": DaraConfig::default();
        "algorithms/dmc.rs": DmcConfig::default();
        "algorithms/igdf.rs": IgdfConfig::default();
        "algorithms/meta_dt.rs": MetaDtConfig::default();
        "algorithms/otdf.rs": OtdfConfig::default();
        "algorithms/rebrac.rs": RebracConfig::default();
        "algorithms/regulariser.rs": RegulariserConfig::paper();
        "algorithms/sac.rs": SacConfig::default();
        "algorithms/srpo.rs": SrpoConfig::default();
        "algorithms/td3_bc.rs": Td3BcConfig::default();
        "models/cvae.rs": CvaeConfig::paper();
        "models/dynamics.rs": DynamicsConfig::default();
        "models/fitted_q.rs": FittedQConfig::default();
        "models/labels.rs": LabelConfig::paper();
        "models/pair_model.rs": PairConfig::default();
        "policies/actor.rs": ActorConfig::default();
    } {
        for line in text.lines().filter_map(|l| l.strip_prefix("//! | ")) {
            let cells: Vec<&str> = line.split(" | ").collect();
            // The last three columns are field, default and source.
            let Some([fields, told, _]) = cells.last_chunk::<3>() else { continue };
            let names: Vec<&str> = fields.split('`').skip(1).step_by(2).collect();
            let several = names.len() > 1;
            for (k, name) in names.iter().enumerate() {
                // `std`² means that the cell gives the square.
                if fields.contains(&format!("`{name}`²")) {
                    continue;
                }
                let Some(found) = config.get(name) else { continue };
                let part = if several { told.split(", ").nth(k).unwrap_or_default() } else { told };
                if let Some(same) = agrees(part, found) {
                    compared += 1;
                    if !same {
                        wrong.push(format!("{file}: `{name}` is {found}, the table says {told}"));
                    }
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(compared > 60, "{compared} values were compared");
}
