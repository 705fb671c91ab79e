//! Policies of other programs as plain numpy arrays (`.npz`), of the kinds in the project's collection of actors.
//!
//! | `kind` | inputs | hidden | action |
//! |---|---|---|---|
//! | `sac_tanh_gaussian` | raw | 2 × ReLU | tanh(μ + σ n), μ = wm h + bm, ln σ = clip(ws h + bs, -20, 2) |
//! | `gaussian_clip` | clip((o - `obs_mean`) / √(`obs_var` + `eps`), ± `clip`) | 2 × `act` | clip(wm h + bm + e^`log_std` n) |
//! | `gaussian_std_plus_1e-6` | (o - `obs_mean`) / (`obs_std` + 1e-6) | 2 × tanh | the same |
//! | `linear_clip` | as `gaussian_clip` | none | clip(wm x) |
//!
//! Weights are `[out, in]`, in f32 or f64, in C or Fortran order.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use tce_base::FileError;
use tce_data::Standardizer;
use tce_nn::{Activation, NamedParameters};
use zip::ZipArchive;

use crate::error::LearnError;
use crate::mlp_policy::{Head, MlpPolicy, PolicySpec};
use crate::npy::{self, Array};

const REMEDY: &str = "see the table of kinds in the documentation of tce_learn::import";

/// Reads one `.npz` policy.
///
/// # Errors
/// If the file cannot be read, is of an unknown kind, or lacks an array.
pub fn load_npz(path: &Path) -> Result<MlpPolicy, LearnError> {
    let arrays = Arrays::read(path)?;
    let kind = arrays.text("kind")?;
    let wm = arrays.matrix("wm")?;
    let (actions, mut layers) = (wm.rows, Vec::new());
    if kind != "linear_clip" {
        layers.push((arrays.matrix("w0")?, arrays.numbers("b0")?));
        layers.push((arrays.matrix("w1")?, arrays.numbers("b1")?));
    }
    let observations = layers.first().map_or(wm.columns, |(w, _)| w.columns);
    let hidden = layers.iter().map(|(w, _)| w.rows).collect();
    let (head, last) = match kind.as_str() {
        "sac_tanh_gaussian" => {
            let (ws, bs) = (arrays.matrix("ws")?, arrays.numbers("bs")?);
            if ws.columns != wm.columns {
                let (found, expected) = (format!("{} columns", ws.columns), format!("{} as in wm", wm.columns));
                return Err(arrays.fault("ws", found, &expected));
            }
            (Head::TanhGaussian, (wm.above(ws), [arrays.numbers("bm")?, bs].concat()))
        }
        "gaussian_clip" | "gaussian_std_plus_1e-6" => {
            (Head::Gaussian { log_std: arrays.numbers("log_std")? }, (wm, arrays.numbers("bm")?))
        }
        "linear_clip" => (Head::Mean, (wm, vec![0.0; actions])),
        other => {
            let known = "sac_tanh_gaussian, gaussian_clip, gaussian_std_plus_1e-6 or linear_clip";
            return Err(arrays.fault("kind", format!("'{other}'"), known));
        }
    };
    layers.push(last);
    let (standardizer, clip) = match kind.as_str() {
        "sac_tanh_gaussian" => (Standardizer::identity(observations), None),
        "gaussian_std_plus_1e-6" => (arrays.standardizer("obs_std", |std| std + 1e-6)?, None),
        _ => {
            let eps = arrays.scalar("eps")?;
            (arrays.standardizer("obs_var", |var| (var + eps).sqrt())?, Some(arrays.scalar("clip")? as f32))
        }
    };
    let activation = match (kind.as_str(), arrays.text("act")) {
        ("linear_clip", _) | ("sac_tanh_gaussian", Err(_)) => Activation::Relu,
        (_, text) => match text?.as_str() {
            "relu" => Activation::Relu,
            "tanh" => Activation::Tanh,
            other => return Err(arrays.fault("act", format!("'{other}'"), "relu or tanh")),
        },
    };
    let spec = PolicySpec {
        observations,
        actions,
        inputs: (0..observations).collect(),
        standardizer,
        clip,
        hidden,
        activation,
        output_activation: Activation::Identity,
        head,
        log_std_range: None,
    };
    let mut weights = NamedParameters::default();
    for (k, (w, b)) in layers.into_iter().enumerate() {
        weights.tensors.insert(format!("policy.layers.{k}.bias"), (vec![1, 1, b.len()], b));
        weights.tensors.insert(format!("policy.layers.{k}.weight"), (vec![1, w.columns, w.rows], w.transposed()));
    }
    MlpPolicy::new(spec, &weights, "policy", path)
}

/// A matrix `[rows, columns]`, row-major.
struct Matrix {
    rows: usize,
    columns: usize,
    data: Vec<f32>,
}

impl Matrix {
    fn transposed(&self) -> Vec<f32> {
        let at = |k: usize| self.data[k % self.rows * self.columns + k / self.rows];
        (0..self.data.len()).map(at).collect()
    }

    fn above(mut self, below: Matrix) -> Matrix {
        self.rows += below.rows;
        self.data.extend(below.data);
        self
    }
}

/// The arrays of one file.
struct Arrays<'a> {
    path: &'a Path,
    by_name: BTreeMap<String, Array>,
}

impl<'a> Arrays<'a> {
    fn read(path: &'a Path) -> Result<Self, LearnError> {
        let io = |e| FileError::new(path, "read as an npz archive", e);
        let file = File::open(path).map_err(|e| FileError::new(path, "open", e))?;
        let mut archive = ZipArchive::new(BufReader::new(file)).map_err(|e| io(e.into()))?;
        let mut by_name = BTreeMap::new();
        for k in 0..archive.len() {
            let entry = archive.by_index(k).map_err(|e| io(e.into()))?;
            let Some(name) = entry.name().strip_suffix(".npy").map(str::to_owned) else { continue };
            by_name.insert(name, array(entry).map_err(io)?);
        }
        Ok(Self { path, by_name })
    }

    fn fault(&self, field: &str, found: String, expected: &str) -> LearnError {
        let (path, field, expected) = (self.path.to_owned(), field.to_owned(), expected.to_owned());
        LearnError::Policy { path, field, found, expected, remedy: REMEDY.into() }
    }

    fn text(&self, name: &str) -> Result<String, LearnError> {
        match self.by_name.get(name) {
            Some(Array::Text(text)) => Ok(text.clone()),
            Some(_) => Err(self.fault(name, "numbers".into(), "text")),
            None => Err(self.fault(name, "nothing".into(), "text")),
        }
    }

    fn array(&self, name: &str, dims: usize) -> Result<(&[usize], &[f64]), LearnError> {
        let expected = format!("an array of {dims} dimensions of finite numbers");
        match self.by_name.get(name) {
            Some(Array::Numbers(shape, values)) if shape.len() == dims && values.iter().all(|v| v.is_finite()) => {
                Ok((shape, values))
            }
            Some(Array::Numbers(shape, _)) => Err(self.fault(name, format!("shape {shape:?}"), &expected)),
            Some(Array::Text(_)) => Err(self.fault(name, "text".into(), &expected)),
            None => Err(self.fault(name, "nothing".into(), &expected)),
        }
    }

    fn scalar(&self, name: &str) -> Result<f64, LearnError> {
        Ok(self.array(name, 0)?.1[0])
    }

    fn numbers(&self, name: &str) -> Result<Vec<f32>, LearnError> {
        Ok(self.array(name, 1)?.1.iter().map(|&v| v as f32).collect())
    }

    fn matrix(&self, name: &str) -> Result<Matrix, LearnError> {
        let (shape, values) = self.array(name, 2)?;
        Ok(Matrix { rows: shape[0], columns: shape[1], data: values.iter().map(|&v| v as f32).collect() })
    }

    fn standardizer(&self, spread: &str, divisor: impl Fn(f64) -> f64) -> Result<Standardizer, LearnError> {
        let std: Vec<f32> = self.array(spread, 1)?.1.iter().map(|&v| divisor(v) as f32).collect();
        Ok(Standardizer { mean: self.numbers("obs_mean")?, ..Standardizer { std, ..Standardizer::identity(0) } })
    }
}

/// Limit on the bytes of an array, including its header; a policy has far fewer.
const LARGEST_ARRAY: u64 = 1 << 28;

fn array(entry: impl Read) -> std::io::Result<Array> {
    let mut bytes = Vec::new();
    entry.take(LARGEST_ARRAY).read_to_end(&mut bytes)?;
    npy::parse(&bytes)
}
