//! Parameters by name: to and from safetensors files, member by member; moving averages of whole networks.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use burn::backend::Flex;
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};
use half::f16;
use multiversion::multiversion;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::dense::is_flex;
use crate::tensors::host;

/// A file of parameters could not be used.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// It could not be read or written.
    #[error(transparent)]
    File(#[from] tce_base::FileError),
    /// It is not a safetensors file, or a damaged one.
    #[error("{}: not a readable safetensors file: {reason}; is it whole?", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What the reader says.
        reason: String,
    },
    /// It holds another network.
    #[error("{}: parameter '{name}': found {found}, expected {expected}; was the file written for another network?", path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// The parameter.
        name: String,
        /// What the file holds.
        found: String,
        /// What the network needs.
        expected: String,
    },
    /// There is no GPU for the networks.
    #[error("no GPU: {0}")]
    NoGpu(String),
}

/// Parameters of a network as named host arrays, with free-text metadata; what a safetensors file holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NamedParameters {
    /// Name → (shape, values row-major).
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    /// Free text, such as a JSON specification.
    pub metadata: BTreeMap<String, String>,
}

impl NamedParameters {
    /// All parameters of `module`, named `{prefix}.{path}`.
    pub fn collect<M: Module>(&mut self, prefix: &str, module: &M) {
        module.visit(&mut Collector { path: vec![prefix.to_owned()], out: &mut self.tensors });
    }

    /// Adds all of `own` under names that begin with `prefix`.
    pub fn extend_under(&mut self, prefix: &str, own: Self) {
        self.tensors.extend(own.tensors.into_iter().map(|(name, tensor)| (format!("{prefix}{name}"), tensor)));
        self.metadata.extend(own.metadata.into_iter().map(|(name, text)| (format!("{prefix}{name}"), text)));
    }

    /// What was added under `prefix`, by its own names.
    pub fn under(&self, prefix: &str) -> Self {
        fn own<T: Clone>(prefix: &str, all: &BTreeMap<String, T>) -> BTreeMap<String, T> {
            all.iter()
                .filter_map(|(name, value)| Some((name.strip_prefix(prefix)?.to_owned(), value.clone())))
                .collect()
        }
        Self { tensors: own(prefix, &self.tensors), metadata: own(prefix, &self.metadata) }
    }

    /// Member `index` of every tensor, as a population of one.
    pub fn member(&self, index: usize) -> Self {
        let take = |(name, (shape, data)): (&String, &(Vec<usize>, Vec<f32>))| {
            let len = data.len() / shape[0];
            let shape = std::iter::once(1).chain(shape[1..].iter().copied()).collect();
            (name.clone(), (shape, data[index * len..(index + 1) * len].to_vec()))
        };
        Self { tensors: self.tensors.iter().map(take).collect(), metadata: self.metadata.clone() }
    }

    /// `module` with the values of this set. `path` is where they came from, for messages.
    ///
    /// # Errors
    /// If a parameter is missing or has another shape.
    pub fn apply<M: Module>(&self, prefix: &str, module: M, path: &Path) -> Result<M, NetworkError> {
        let mut loader = Loader { path: vec![prefix.to_owned()], from: self, file: path, error: None };
        let module = module.map(&mut loader);
        match loader.error {
            Some(error) => Err(error),
            None => Ok(module),
        }
    }

    /// The bytes of a safetensors file. The same parameters give the same bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.serialize(Dtype::F32, |data| data.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// The same in half precision: half the size, for weights that need no more.
    pub fn to_half_bytes(&self) -> Vec<u8> {
        self.serialize(Dtype::F16, |data| data.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect())
    }

    fn serialize(&self, dtype: Dtype, encode: impl Fn(&[f32]) -> Vec<u8>) -> Vec<u8> {
        let bytes: BTreeMap<&String, Vec<u8>> =
            self.tensors.iter().map(|(name, (_, data))| (name, encode(data))).collect();
        let views = self.tensors.iter().map(|(name, (shape, _))| {
            let view = TensorView::new(dtype, shape.clone(), &bytes[name]).expect("shape and data agree");
            (name.clone(), view)
        });
        let metadata: Option<HashMap<String, String>> = match self.metadata.len() {
            0 => None,
            // A hash map has no order: more than one entry would make the bytes depend on chance.
            1 => Some(self.metadata.clone().into_iter().collect()),
            _ => {
                Some(HashMap::from([("tce".to_owned(), serde_json::to_string(&self.metadata).expect("plain strings"))]))
            }
        };
        safetensors::serialize(views, metadata).expect("names and shapes are valid")
    }

    /// Writes a safetensors file, whole or not at all.
    pub fn save(&self, path: &Path) -> Result<(), NetworkError> {
        Ok(tce_base::write_atomically(path, &self.to_bytes())?)
    }

    /// Every value rounded to half precision (11 significant bits): what [`to_half_bytes`](Self::to_half_bytes) keeps.
    pub fn to_half(&self) -> Self {
        let round = |v: &f32| f16::from_f32(*v).to_f32();
        let tensors = self
            .tensors
            .iter()
            .map(|(name, (shape, data))| (name.clone(), (shape.clone(), data.iter().map(round).collect())));
        Self { tensors: tensors.collect(), metadata: self.metadata.clone() }
    }

    /// Reads a safetensors file of f32 or f16 tensors.
    pub fn load(path: &Path) -> Result<Self, NetworkError> {
        let bytes = std::fs::read(path).map_err(|e| tce_base::FileError::new(path, "read", e))?;
        Self::from_bytes(&bytes, path)
    }

    /// Parses the bytes of a safetensors file; `path` is for messages.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, NetworkError> {
        let format = |reason: String| NetworkError::Format { path: path.to_owned(), reason };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| format(e.to_string()))?;
        let file = SafeTensors::deserialize(bytes).map_err(|e| format(e.to_string()))?;
        let mut out = Self::default();
        for (name, view) in file.tensors() {
            let data = match view.dtype() {
                Dtype::F32 => {
                    let values = view.data().chunks_exact(4);
                    values.map(|b| f32::from_le_bytes(b.try_into().expect("4 bytes"))).collect()
                }
                Dtype::F16 => {
                    let values = view.data().chunks_exact(2);
                    values.map(|b| f16::from_le_bytes(b.try_into().expect("2 bytes")).to_f32()).collect()
                }
                other => {
                    return Err(NetworkError::Mismatch {
                        path: path.to_owned(),
                        name,
                        found: format!("{other:?}"),
                        expected: "F32 or F16".into(),
                    });
                }
            };
            out.tensors.insert(name, (view.shape().to_vec(), data));
        }
        for (key, value) in header.metadata().iter().flatten() {
            match (key.as_str(), serde_json::from_str(value)) {
                ("tce", Ok(all)) => out.metadata = all,
                _ => {
                    out.metadata.insert(key.clone(), value.clone());
                }
            }
        }
        Ok(out)
    }
}

struct Collector<'a> {
    path: Vec<String>,
    out: &'a mut BTreeMap<String, (Vec<usize>, Vec<f32>)>,
}

impl ModuleVisitor for Collector<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let t = param.val();
        self.out.insert(self.path.join("."), (t.dims().to_vec(), host(t)));
    }
}

struct Loader<'a> {
    path: Vec<String>,
    from: &'a NamedParameters,
    file: &'a Path,
    error: Option<NetworkError>,
}

impl ModuleMapper for Loader<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = self.path.join(".");
        let (id, old, mapper) = param.consume();
        let dims = old.dims().to_vec();
        let tensor = match self.from.tensors.get(&name) {
            Some((shape, data)) if *shape == dims => {
                let device = old.device();
                let new = Tensor::from_data(TensorData::new(data.clone(), shape.clone()), &device);
                if old.is_require_grad() { new.require_grad() } else { new }
            }
            other => {
                self.error.get_or_insert(NetworkError::Mismatch {
                    path: self.file.to_owned(),
                    name,
                    found: other.map_or("nothing".into(), |(shape, _)| format!("shape {shape:?}")),
                    expected: format!("shape {dims:?}"),
                });
                old
            }
        };
        Param::from_mapped_value(id, tensor, mapper)
    }
}

/// Number of scalars in a module.
pub fn parameter_count<M: Module>(module: &M) -> usize {
    module.num_params()
}

/// average ← average + rate (online − average), parameter by parameter (Polyak averaging, EMA). `average` and `online`
/// are networks of one kind; the result takes no part in autodiff.
pub fn moving_average<M: Module>(average: M, online: &M, rate: f64) -> M {
    let mut values = Vec::new();
    online.visit(&mut Values { out: &mut values });
    average.map(&mut Averager { values: values.into_iter(), rate: rate as f32 })
}

struct Values<'a> {
    out: &'a mut Vec<Tensor<1>>,
}

impl ModuleVisitor for Values<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.out.push(param.val().inner().reshape([-1]));
    }
}

struct Averager {
    values: std::vec::IntoIter<Tensor<1>>,
    rate: f32,
}

impl ModuleMapper for Averager {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, tensor, mapper) = param.consume();
        let shape = tensor.shape();
        let (average, online) = (tensor.inner().reshape([-1]), self.values.next().expect("networks of one kind"));
        Param::from_mapped_value(id, follow(average, online, self.rate).reshape(shape), mapper)
    }
}

/// average + rate (online − average), in place on the CPU where the average has one owner.
pub(crate) fn follow(average: Tensor<1>, online: Tensor<1>, rate: f32) -> Tensor<1> {
    if !is_flex(&average) {
        return average.clone() + (online - average) * rate;
    }
    let primitive = |t: Tensor<1>| t.try_into_primitive::<Flex>().expect("on the CPU and outside of autodiff");
    let (mut average, online) = (primitive(average), primitive(online).to_contiguous());
    lerp(average.storage_mut(), online.as_slice().expect("contiguous"), rate);
    Tensor::from_primitive::<Flex>(average)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn lerp(average: &mut [f32], online: &[f32], rate: f32) {
    for (a, o) in average.iter_mut().zip(online) {
        *a += rate * (o - *a);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Device, MlpConfig, cpu};
    use tce_base::Streams;

    fn network(seeds: &[u64], device: &Device) -> crate::Mlp {
        let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
        MlpConfig::relu(3, &[4], 2).init(&members, "n", device)
    }

    #[test]
    fn files_keep_every_bit_and_every_member() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("n.safetensors");
        let mut saved = NamedParameters::default();
        saved.collect("n", &network(&[1, 2], &cpu()));
        saved.metadata.insert("a".into(), "1".into());
        saved.metadata.insert("b".into(), "2".into());
        saved.save(&path).unwrap();
        let loaded = NamedParameters::load(&path).unwrap();
        assert_eq!(saved, loaded);
        assert_eq!(saved.to_bytes(), loaded.to_bytes());
        let second = loaded.member(1).apply("n", network(&[9], &cpu()), &path).unwrap();
        let mut again = NamedParameters::default();
        again.collect("n", &second);
        assert_eq!(again.tensors, saved.member(1).tensors);
    }

    #[test]
    fn half_precision_files_hold_the_rounded_values() {
        let mut saved = NamedParameters::default();
        saved.collect("n", &network(&[1], &cpu()));
        saved.metadata.insert("a".into(), "1".into());
        let (bytes, rounded) = (saved.to_half_bytes(), saved.to_half());
        assert!(bytes.len() < saved.to_bytes().len());
        assert_eq!(NamedParameters::from_bytes(&bytes, Path::new("n")).unwrap(), rounded);
        for (name, (_, data)) in &saved.tensors {
            for (full, half) in data.iter().zip(&rounded.tensors[name].1) {
                assert!((full - half).abs() <= full.abs() / 2048.0 + 6e-8, "{full} {half}");
            }
        }
    }

    #[test]
    fn another_network_is_refused() {
        let mut saved = NamedParameters::default();
        saved.collect("n", &network(&[1], &cpu()));
        let other = MlpConfig::relu(3, &[5], 2).init(&[Streams::new(0)], "n", &cpu());
        let error = saved.apply("n", other, Path::new("n.safetensors")).unwrap_err().to_string();
        assert!(
            error.contains("n.layers.0.weight") && error.contains("[1, 3, 4]") && error.contains("[1, 3, 5]"),
            "{error}"
        );
    }

    #[test]
    fn a_truncated_file_is_refused() {
        let mut saved = NamedParameters::default();
        saved.collect("n", &network(&[1], &cpu()));
        let bytes = saved.to_bytes();
        for len in 0..bytes.len() {
            assert!(NamedParameters::from_bytes(&bytes[..len], Path::new("x")).is_err());
        }
    }

    #[test]
    fn averages_move_towards_the_online_network() {
        let online = network(&[1], &cpu().autodiff());
        let average = moving_average(network(&[2], &cpu()), &online, 0.25);
        let value = |m: &crate::Mlp| host(m.layers[0].weight.val());
        for ((a, b), o) in value(&average).iter().zip(value(&network(&[2], &cpu()))).zip(value(&online)) {
            assert!((a - (0.75 * b + 0.25 * o)).abs() < 1e-6);
        }
    }
}
