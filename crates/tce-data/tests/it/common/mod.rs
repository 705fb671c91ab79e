//! Test files in the form that other programs write.
#![allow(dead_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use hdf5_pure::{EnumTypeBuilder, FileBuilder, make_i8_type};
use tce_data::{DataError, LoadOptions, Loaded, Problem, Transitions};

/// `n` rows of one episode: s_i = (i, -i), s'_i = s_{i+1}, a = .5, r = i.
pub struct Rows {
    pub observations: Vec<f32>,
    pub actions: Vec<f32>,
    pub next: Vec<f32>,
    pub rewards: Vec<f32>,
    pub terminals: Vec<bool>,
    pub timeouts: Vec<bool>,
}

pub fn rows(n: usize) -> Rows {
    let state = |i: usize| [i as f32, -(i as f32)];
    Rows {
        observations: (0..n).flat_map(state).collect(),
        actions: vec![0.5; n],
        next: (1..=n).flat_map(state).collect(),
        rewards: (0..n).map(|i| i as f32).collect(),
        terminals: vec![false; n],
        timeouts: vec![false; n],
    }
}

/// Like [`rows`], in episodes of these lengths. Each begins 1000 higher than the one before it ended, and every s' is
/// the next row's state, even across episodes.
pub fn rebuilt(lengths: &[usize]) -> Rows {
    let n = lengths.iter().sum();
    let episode = lengths.iter().enumerate().flat_map(|(k, &length)| std::iter::repeat_n(k, length));
    let state = |(i, k): (usize, usize)| [(i + 1000 * k) as f32, -((i + 1000 * k) as f32)];
    let observations: Vec<f32> = episode.enumerate().flat_map(state).collect();
    let mut next = observations[2..].to_vec();
    next.extend([0.0, 0.0]);
    Rows { observations, next, ..rows(n) }
}

pub fn enum_flags(builder: &mut FileBuilder, name: &str, flags: &[bool]) {
    let ty = EnumTypeBuilder::with_base(make_i8_type()).u8_value("FALSE", 0).u8_value("TRUE", 1).build().unwrap();
    let bytes = flags.iter().map(|&f| f as u8).collect();
    builder.create_dataset(name).with_raw_data(ty, bytes, flags.len() as u64);
}

impl Rows {
    pub fn len(&self) -> u64 {
        self.rewards.len() as u64
    }

    /// D4RL's fields without `next_observations`; flags as booleans.
    pub fn d4rl(&self) -> FileBuilder {
        let mut b = FileBuilder::new();
        b.create_dataset("observations").with_f32_data(&self.observations).with_shape(&[self.len(), 2]);
        b.create_dataset("actions").with_f32_data(&self.actions).with_shape(&[self.len(), 1]);
        b.create_dataset("rewards").with_f32_data(&self.rewards);
        enum_flags(&mut b, "terminals", &self.terminals);
        enum_flags(&mut b, "timeouts", &self.timeouts);
        b
    }

    pub fn with_next(&self, mut b: FileBuilder) -> FileBuilder {
        b.create_dataset("next_observations").with_f32_data(&self.next).with_shape(&[self.len(), 2]);
        b
    }

    /// As in OTDF's medium and expert files: (N, 1), f64 terminals, a metadata group, small gzip chunks.
    pub fn otdf(&self) -> FileBuilder {
        let n = self.len();
        let mut b = FileBuilder::new();
        let chunk = n.div_ceil(3);
        for (name, data) in [("observations", &self.observations), ("next_observations", &self.next)] {
            b.create_dataset(name).with_f32_data(data).with_shape(&[n, 2]).with_chunks(&[chunk, 1]).with_deflate(4);
        }
        b.create_dataset("actions").with_f32_data(&self.actions).with_shape(&[n, 1]);
        b.create_dataset("rewards").with_f32_data(&self.rewards).with_shape(&[n, 1]);
        let terminals: Vec<f64> = self.terminals.iter().map(|&t| t as u8 as f64).collect();
        b.create_dataset("terminals").with_f64_data(&terminals).with_shape(&[n, 1]);
        let mut metadata = b.create_group("metadata");
        metadata.create_dataset("algorithm").with_vlen_strings(&["SAC"]);
        metadata.create_dataset("seed").with_i64_data(&[0]);
        b.add_group(metadata.finish());
        b
    }
}

pub fn write(dir: &tempfile::TempDir, name: &str, builder: FileBuilder) -> PathBuf {
    let path = dir.path().join(name);
    builder.write(&path).unwrap();
    path
}

pub fn load(path: &Path) -> Result<Loaded, DataError> {
    tce_data::load(path, &benchmark())
}

/// The options for a file of a benchmark robot.
pub fn benchmark() -> LoadOptions {
    LoadOptions { step_limit: Some(1000), ..LoadOptions::default() }
}

/// Asserts that `error` is of kind `problem` and that its message names the file, the field and all of `parts`.
#[track_caller]
pub fn assert_refused(error: DataError, problem: Problem, path: &Path, field: &str, parts: &[&str]) {
    let text = error.to_string();
    assert_eq!(error.problem(), Some(problem), "{text}");
    for part in [path.to_str().unwrap(), &format!("`{field}`"), "found", "expected"].iter().chain(parts) {
        assert!(text.contains(part), "`{part}` is not in: {text}");
    }
}

/// `n` rows of plausible numbers in the given dimensions. An episode ends every `length` rows.
pub fn synthetic(n: usize, obs_dim: usize, act_dim: usize, length: usize) -> Transitions {
    use rand::RngExt;
    let mut rng = tce_base::Streams::new(7).stream("synthetic");
    let mut draw = |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect() };
    Transitions {
        obs_dim,
        act_dim,
        observations: draw(n * obs_dim),
        actions: draw(n * act_dim),
        rewards: draw(n),
        next_observations: draw(n * obs_dim),
        terminals: (0..n).map(|i| i % (3 * length) + 1 == 3 * length).collect(),
        timeouts: (0..n).map(|i| i % length + 1 == length && i % (3 * length) + 1 != 3 * length).collect(),
        known: vec![true; n],
    }
}

/// The shared folder with the public files, if it exists.
pub fn shared() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let path = std::env::var_os("TCE_SHARED").map_or(default, PathBuf::from);
    path.join("datasets/otdf").is_dir().then_some(path)
}

/// Runs `script` with `argument`; `None` if there is no Python with h5py (`TCE_PYTHON`, default python3).
#[track_caller]
pub fn python(script: &str, argument: &Path) -> Option<String> {
    let python = std::env::var("TCE_PYTHON").unwrap_or_else(|_| "python3".into());
    let able = Command::new(&python).args(["-c", "import h5py, numpy"]).output().is_ok_and(|o| o.status.success());
    if !able {
        eprintln!("SKIPPED: {python} cannot import h5py and numpy (set TCE_PYTHON)");
        return None;
    }
    let out = Command::new(&python).args(["-c", script]).arg(argument).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    Some(String::from_utf8(out.stdout).unwrap())
}

/// The Python of a virtual environment under `target/` with `packages`, which provide `imports`. It is created if
/// missing; `Err` says why there is none.
///
/// It is built in a temporary folder and moved as a whole, so that parallel test processes see no partial one.
pub fn environment(name: &str, packages: &[&str], imports: &str) -> Result<PathBuf, String> {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let place = root.join(name);
    let python = |folder: &Path| folder.join("bin/python");
    let works = |folder: &Path| {
        Command::new(python(folder))
            .args(["-c", &format!("import {imports}")])
            .output()
            .is_ok_and(|o| o.status.success())
    };
    if works(&place) {
        return Ok(python(&place));
    }
    let run = |command: &mut Command| -> Result<(), String> {
        let Output { status, stderr, .. } = command.output().map_err(|e| format!("{command:?}: {e}"))?;
        let why = String::from_utf8_lossy(&stderr);
        let last = why.lines().rfind(|l| !l.trim().is_empty()).unwrap_or("").to_owned();
        if status.success() { Ok(()) } else { Err(format!("{command:?}: {last}")) }
    };
    fs::create_dir_all(root).map_err(|e| e.to_string())?;
    let making = tempfile::Builder::new().prefix(name).tempdir_in(root).map_err(|e| e.to_string())?;
    let base = std::env::var("TCE_PYTHON").unwrap_or_else(|_| "python3".into());
    run(Command::new(base).args(["-m", "venv"]).arg(making.path()))?;
    // Wheels only: building h5py from source takes minutes and needs HDF5's headers.
    let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"];
    let patience = ["--retries", "1", "--timeout", "15"];
    run(Command::new(python(making.path())).args(pip).args(patience).args(packages))?;
    if !works(making.path()) {
        return Err(format!("{name} was installed, and cannot be imported"));
    }
    // Another process may have been faster, or a broken environment may be in the way.
    if fs::rename(making.path(), &place).is_err() && !works(&place) {
        fs::remove_dir_all(&place).map_err(|e| e.to_string())?;
        fs::rename(making.path(), &place).map_err(|e| e.to_string())?;
    }
    Ok(python(&place))
}

#[global_allocator]
static ALLOCATOR: Largest = Largest;

/// Records the largest single allocation.
pub struct Largest;

pub static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: all calls are passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Largest {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}
