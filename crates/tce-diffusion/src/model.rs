//! A trained score network with the process it was trained for: sampling, files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::random::{fill_normal, fill_uniform};
use tce_base::{FileError, Progress, Sealed, Streams, read_sealed, write_sealed};
use tce_nn::{Device, NamedParameters, NetworkError, Tensor, host, on_threads_of, tensor};

use crate::{BoundNetwork, Denoiser, DiffusionError, Guided, Level, NetworkConfig, Process, Sampler, ScoreNetwork};

/// Rows sampled together. Part of the definition of the result: each chunk has its own noise stream, and the Langevin
/// step size is an average over the chunk.
const CHUNK: usize = 4096;
/// Key of the specification in a file's metadata.
const SPECIFICATION: &str = "score_model";
/// Prefix of the parameters' names in a file.
const PREFIX: &str = "score";

/// A population of score networks and their process.
#[derive(Clone, Debug)]
pub struct ScoreModel {
    config: NetworkConfig,
    process: Process,
    network: ScoreNetwork,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Specification {
    network: NetworkConfig,
    process: Process,
}

/// What to sample.
#[derive(Clone, Copy, Debug)]
pub struct Request<'a> {
    /// Names the noise streams: two requests that must not share their noise (states, next states) need two names.
    pub name: &'a str,
    /// Rows wanted per member.
    pub rows: usize,
    /// Conditions `[P, rows, c]`, or `[rows, c]` for all members.
    pub condition: &'a [f32],
    /// w of classifier-free guidance ([`Guided`]) against the condition of all zeros, which costs a second evaluation; None: the
    /// conditional model as it is. For models trained with [`crate::ScoreData::with_dropout`].
    pub guidance: Option<f64>,
    /// Training rows `[P, rows, d]` or `[rows, d]` to start from; needed where [`Process::starts_at_data`] only.
    pub start: Option<&'a [f32]>,
    /// Where finished chunks are kept and taken from, so that an interrupted sampling goes on.
    pub kept: Option<Chunks<'a>>,
}

impl Request<'_> {
    /// Network evaluations per row.
    pub fn evaluations(&self, sampler: &Sampler) -> usize {
        sampler.evaluations() * if self.guidance.is_some() { 2 } else { 1 }
    }
}

/// Sampled chunks on disk: one file of checksummed f32 for each member and 4096 rows.
#[derive(Clone, Copy, Debug)]
pub struct Chunks<'a> {
    /// Their directory.
    pub directory: &'a Path,
    /// Cache key: hash of all inputs of the samples, besides name, member and chunk.
    pub key: &'a str,
}

impl Chunks<'_> {
    fn path(&self, name: &str, member: usize, chunk: usize) -> PathBuf {
        self.directory.join(format!("{name}-{member}-{chunk}.chunk"))
    }

    /// The chunk of `n` numbers, if it is there and whole.
    fn load(&self, name: &str, member: usize, chunk: usize, n: usize) -> Result<Option<Vec<f32>>, FileError> {
        let read = read_sealed(&self.path(name, member, chunk), self.key)?;
        Ok(match read {
            Sealed::Whole(bytes) if bytes.len() == 4 * n => {
                Some(bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("4 bytes"))).collect())
            }
            // Sampled again, to the same numbers.
            _ => None,
        })
    }

    fn save(&self, name: &str, member: usize, chunk: usize, rows: &[f32]) -> Result<(), FileError> {
        let bytes: Vec<u8> = rows.iter().flat_map(|v| v.to_le_bytes()).collect();
        write_sealed(&self.path(name, member, chunk), self.key, &bytes)
    }
}

impl ScoreModel {
    pub(crate) fn new(config: NetworkConfig, process: Process, network: ScoreNetwork) -> Self {
        Self { config, process, network }
    }

    /// The sizes of the network.
    pub fn config(&self) -> NetworkConfig {
        self.config
    }

    /// The process it was trained for.
    pub fn process(&self) -> Process {
        self.process
    }

    /// Members of the population.
    pub fn members(&self) -> usize {
        self.network.members()
    }

    /// The denoiser of all members for rows with the conditions `[P or 1, B, c]`.
    pub fn bind<'a>(&'a self, condition: Tensor<3>) -> impl Denoiser + 'a {
        Bound { network: self.network.bind(condition), process: self.process, progress: None }
    }

    /// Member `index` as a population of one.
    ///
    /// # Panics
    /// If there is no such member.
    pub fn member(&self, index: usize) -> Self {
        assert!(index < self.members(), "member {index} of {}", self.members());
        let device = self.network.device();
        let parameters = self.parameters().member(index);
        Self::from_parameters(&parameters, Path::new("a member"), &device).expect("a model of this kind")
    }

    /// Samples rows `[P, rows, d]`, row-major; member i draws from `streams[i]` (`sample/{name}`, one index per chunk of
    /// 4096 rows), so that the bytes do not depend on the number of threads. `progress` counts rows × evaluations of the sampler.
    ///
    /// # Errors
    /// If the request does not fit the model or a sampler setting is unusable; if the user interrupts.
    pub fn sample(
        &self,
        request: Request,
        sampler: &Sampler,
        streams: &[Streams],
        progress: Option<&Progress>,
    ) -> Result<Vec<f32>, DiffusionError> {
        sampler.check()?;
        let (members, rows, d, c) = (self.members(), request.rows, self.config.dims, self.config.condition);
        if streams.len() != members {
            return Err(DiffusionError::input("streams", streams.len(), format!("one per member, {members}")));
        }
        let fits = |what: &str, values: &[f32], width: usize| {
            if values.len() == rows * width || values.len() == members * rows * width {
                return Ok(());
            }
            let expected = format!("{rows} rows of {width}, or {members} times as many");
            Err(DiffusionError::input(
                format!("{what} of '{}'", request.name),
                format!("{} numbers", values.len()),
                expected,
            ))
        };
        fits("condition", request.condition, c)?;
        if let Some(w) = request.guidance.filter(|w| !w.is_finite()) {
            return Err(DiffusionError::input(format!("guidance of '{}'", request.name), w, "a finite number"));
        }
        let start = request.start.filter(|_| self.process.starts_at_data());
        match start {
            Some(start) => fits("start", start, d)?,
            None if self.process.starts_at_data() => {
                let expected = "training rows, because process.start = \"data\"";
                return Err(DiffusionError::input(format!("start of '{}'", request.name), "nothing", expected));
            }
            None => {}
        }
        let networks: Vec<Self> = (0..members).map(|i| self.member(i)).collect();
        let mut out = vec![0.0; members * rows * d];
        if rows == 0 {
            return Ok(out);
        }
        let tasks: Vec<_> = out
            .chunks_mut(rows * d)
            .enumerate()
            .flat_map(|(m, member)| member.chunks_mut(CHUNK * d).enumerate().map(move |(k, chunk)| (m, k, chunk)))
            .collect();
        let sample = |(m, k, chunk): (usize, usize, &mut [f32])| {
            let n = chunk.len() / d;
            if let Some(kept) = &request.kept
                && let Some(rows) = kept.load(request.name, m, k, chunk.len()).map_err(NetworkError::from)?
            {
                if let Some(progress) = progress {
                    progress.inc((n * sampler.evaluations()) as u64);
                }
                chunk.copy_from_slice(&rows);
                return Ok(());
            }
            let part = |values: &[f32], width: usize| -> Vec<f32> {
                let member = if values.len() == rows * width { 0 } else { m * rows };
                values[(member + k * CHUNK) * width..][..n * width].to_vec()
            };
            let condition = part(request.condition, c);
            let start = start.map(|s| part(s, d));
            let rng = streams[m].indexed(&format!("sample/{}", request.name), k as u64);
            let rows = networks[m].sample_chunk(condition, request.guidance, start, n, sampler, rng, progress)?;
            chunk.copy_from_slice(&rows);
            match &request.kept {
                Some(kept) => Ok(kept.save(request.name, m, k, &rows).map_err(NetworkError::from)?),
                None => Ok::<_, DiffusionError>(()),
            }
        };
        on_threads_of(&self.network.device(), || tasks.into_par_iter().try_for_each(sample))?;
        Ok(out)
    }

    /// Samples `n` rows of a population of one.
    #[allow(clippy::too_many_arguments)]
    fn sample_chunk(
        &self,
        condition: Vec<f32>,
        guidance: Option<f64>,
        start: Option<Vec<f32>>,
        n: usize,
        sampler: &Sampler,
        mut rng: tce_base::Rng,
        progress: Option<&Progress>,
    ) -> Result<Vec<f32>, DiffusionError> {
        let device = self.network.device();
        let d = self.config.dims;
        let mut normal = || {
            let mut z = vec![0.0; n * d];
            fill_normal(&mut rng, &mut z);
            tensor(z, [1, n, d], &device)
        };
        let width = self.config.condition;
        let bound = |condition: Vec<f32>, progress| {
            let network = self.network.bind(tensor(condition, [1, n, width], &device));
            Bound { network, process: self.process, progress }
        };
        let with = bound(condition, progress);
        let noise = normal() * self.process.start_std();
        let x = match start {
            Some(rows) => noise + tensor(rows, [1, n, d], &device) * self.process.level(1.0).alpha,
            None => noise,
        };
        let rows = match guidance {
            None => sampler.run(&self.process, &with, x, &mut normal)?,
            Some(weight) => {
                let guided = Guided { with, without: bound(vec![0.0; n * width], None), weight };
                sampler.run(&self.process, &guided, x, &mut normal)?
            }
        };
        Ok(host(rows))
    }

    /// The parameters, with the specification in the metadata.
    pub fn parameters(&self) -> NamedParameters {
        let mut out = NamedParameters::default();
        out.collect(PREFIX, &self.network);
        let specification = Specification { network: self.config, process: self.process };
        let json = serde_json::to_string(&specification).expect("plain numbers");
        out.metadata = BTreeMap::from([(SPECIFICATION.to_owned(), json)]);
        out
    }

    /// The model that [`ScoreModel::parameters`] describes; `path` is where they came from, for messages.
    ///
    /// # Errors
    /// If the specification is missing or does not fit the parameters.
    pub fn from_parameters(from: &NamedParameters, path: &Path, device: &Device) -> Result<Self, DiffusionError> {
        let format = |reason: String| NetworkError::Format { path: path.to_owned(), reason };
        let json = from.metadata.get(SPECIFICATION);
        let json = json.ok_or_else(|| format(format!("the metadata has no '{SPECIFICATION}': no score model")))?;
        let Specification { network: config, process } =
            serde_json::from_str(json).map_err(|e| format(format!("metadata '{SPECIFICATION}': {e}")))?;
        config.check()?;
        process.check()?;
        let members = from.tensors.values().next().map_or(0, |(shape, _)| shape[0]);
        if members == 0 {
            return Err(format("no parameters".into()).into());
        }
        // The values do not matter, only the shapes: all are replaced.
        let empty = config.init(&vec![Streams::new(0); members], PREFIX, device);
        Ok(Self { config, process, network: from.apply(PREFIX, empty, path)? })
    }

    /// Writes a safetensors file, whole or not at all.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), DiffusionError> {
        Ok(self.parameters().save(path)?)
    }

    /// Reads what [`ScoreModel::save`] wrote.
    ///
    /// # Errors
    /// If the file cannot be read or holds something else.
    pub fn load(path: &Path, device: &Device) -> Result<Self, DiffusionError> {
        Self::from_parameters(&NamedParameters::load(path)?, path, device)
    }
}

struct Bound<'a> {
    network: BoundNetwork<'a>,
    process: Process,
    progress: Option<&'a Progress>,
}

impl Denoiser for Bound<'_> {
    fn denoise(&self, x: Tensor<3>, level: Level) -> Tensor<3> {
        let c = self.process.precondition(level);
        let [_, rows, _] = x.dims();
        let scaled = if c.scale == 1.0 { x.clone() } else { x.clone() * c.scale };
        let f = self.network.forward(scaled, c.time);
        if let Some(progress) = self.progress {
            progress.inc(rows as u64);
        }
        x * c.skip + f * c.out
    }
}

/// Labels ŷ ~ U(0, `y_max`), one per sample, from `streams` (`labels/{name}`).
pub fn uniform_labels(streams: &Streams, name: &str, n: usize, y_max: f32) -> Vec<f32> {
    let mut labels = vec![0.0; n];
    fill_uniform(&mut streams.stream(&format!("labels/{name}")), &mut labels);
    labels.iter_mut().for_each(|y| *y *= y_max);
    labels
}
