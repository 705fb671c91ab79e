//! Damaged and hostile files: no reader may panic, or take memory out of proportion to the file.
//!
//! Each target changes the seeds in `fuzz/seeds` (and files made here) at random, for `TCE_FUZZ_SECONDS` seconds, 2 unless set.
//! `cargo nextest run --release -p tce fuzz` with `TCE_FUZZ_SECONDS=600` is the long run. The input at work lies in the temporary folder
//! that is printed when a target fails.

use std::alloc::{GlobalAlloc, Layout, System};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use hdf5_pure::FileBuilder;
use rand::RngExt;
use tce_base::{Rng, Streams, write_sealed};
use tce_data::{LoadOptions, Standardizer, Transitions, load};
use tce_diffusion::ScoreModel;
use tce_learn::import::load_npz;
use tce_learn::{Buffer, Member, MetaDt, MetaDtConfig, Place, Policy, PolicyLearner};
use tce_nn::{Checkpoints, NamedParameters, cpu};
use tce_run::layers::{Layered, Preset};
use tce_run::sweep::Manifest;
use tce_zoo::exhibits::{Card, Exhibit};

/// Counts bytes that are taken.
struct Counting;

static TAKEN: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: the system's allocator, with counters beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = TAKEN.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(now, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        TAKEN.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn seeds(names: &[&str]) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    names.iter().map(|name| std::fs::read(folder.join(name)).expect("a committed seed")).collect()
}

const NUMBERS: [u64; 12] =
    [0, 1, 0x7f, 0x80, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 40, i64::MAX as u64, u64::MAX];

/// One to six changes: bits, numbers of all widths, and ranges cut out, doubled, or taken from another seed.
fn mutate(seeds: &[Vec<u8>], rng: &mut Rng) -> Vec<u8> {
    let mut bytes = seeds[rng.random_range(0..seeds.len())].clone();
    for _ in 0..rng.random_range(1..=6) {
        if bytes.is_empty() {
            return bytes;
        }
        let at = rng.random_range(0..bytes.len());
        let end = (at + rng.random_range(0..64usize)).min(bytes.len());
        match rng.random_range(0..8) {
            0 | 1 => bytes[at] ^= 1 << rng.random_range(0..8),
            2 => bytes[at] = rng.random(),
            3 | 4 => {
                let number = NUMBERS[rng.random_range(0..NUMBERS.len())].to_le_bytes();
                let width = [1, 2, 4, 8][rng.random_range(0..4usize)].min(bytes.len() - at);
                bytes[at..at + width].copy_from_slice(&number[..width]);
            }
            5 => drop(bytes.drain(at..end)),
            6 => {
                let other = &seeds[rng.random_range(0..seeds.len())];
                let from = rng.random_range(0..other.len());
                let piece = other[from..(from + end - at).min(other.len())].to_vec();
                bytes.splice(at..at, piece);
            }
            _ => bytes.truncate(end),
        }
    }
    bytes
}

/// Feeds `read` with changed seeds; `ratio` is how many times a file's size it may take.
fn fuzz(name: &str, seeds: Vec<Vec<u8>>, ratio: usize, read: impl Fn(&[u8], &Path)) {
    let seconds = std::env::var("TCE_FUZZ_SECONDS").ok().and_then(|s| s.parse().ok()).unwrap_or(2.0);
    let shared = PathBuf::from("/dev/shm");
    let folder = if shared.is_dir() { tempfile::tempdir_in(shared) } else { tempfile::tempdir() }.unwrap();
    let path = folder.path().join(format!("input-{name}"));
    let mut rng = Streams::new(std::process::id().into()).stream(name);
    let until = Instant::now() + Duration::from_secs_f64(seconds);
    let (mut count, mut worst) = (0u64, 0f64);
    // A panic that is caught need not print itself a thousand times.
    std::panic::set_hook(Box::new(|_| {}));
    let mut inputs = seeds.clone();
    while count < seeds.len() as u64 || Instant::now() < until {
        let bytes = inputs.pop().unwrap_or_else(|| mutate(&seeds, &mut rng));
        std::fs::write(&path, &bytes).unwrap();
        let before = TAKEN.load(Ordering::Relaxed);
        PEAK.store(before, Ordering::Relaxed);
        let outcome = catch_unwind(AssertUnwindSafe(|| read(&bytes, &path)));
        let taken = PEAK.load(Ordering::Relaxed).saturating_sub(before);
        let limit = ratio * bytes.len() + (4 << 20);
        worst = worst.max(taken as f64 / limit as f64);
        if outcome.is_err() || taken > limit {
            let _ = std::panic::take_hook();
            let kept = std::env::temp_dir().join(format!("tce-fuzz-{name}-{}", std::process::id()));
            std::fs::write(&kept, &bytes).unwrap();
            let reason = outcome.err().map_or_else(
                || format!("{taken} bytes taken for a file of {}", bytes.len()),
                |panic| {
                    let text = panic.downcast_ref::<String>().cloned();
                    format!(
                        "panic: {}",
                        text.or_else(|| panic.downcast_ref::<&str>().map(ToString::to_string)).unwrap_or_default()
                    )
                },
            );
            panic!("{name}, input {count}, kept as {}: {reason}", kept.display());
        }
        count += 1;
    }
    let _ = std::panic::take_hook();
    eprintln!("{name}: {count} executions in {seconds} s; at most {:.0} % of the memory allowed", 100.0 * worst);
}

#[test]
fn fuzz_hdf5() {
    // Deflate makes up to 1032 bytes of one, and rows are kept as they are read and as they are used.
    let mut all = seeds(&["d4rl-gzip.hdf5", "otdf-plain.hdf5", "latest.hdf5"]);
    all.extend([minari_episodes(), robomimic_demonstrations()]);
    fuzz("hdf5", all, 300, |_, path| {
        if let Ok(loaded) = load(path, &LoadOptions { all_columns: true, ..LoadOptions::default() }) {
            let _ = tce_data::inspect(&loaded.transitions, Some(1000));
        }
    });
}

/// Two episodes in Minari's layout, with a state of two arrays.
fn minari_episodes() -> Vec<u8> {
    let mut file = FileBuilder::new();
    for (name, n) in [("episode_0", 5usize), ("episode_1", 3)] {
        let mut episode = file.create_group(name);
        let mut state = episode.create_group("observations");
        state.create_dataset("a").with_f32_data(&vec![0.5; 2 * (n + 1)]).with_shape(&[n as u64 + 1, 2]);
        state.create_dataset("b").with_f64_data(&vec![0.25; n + 1]);
        episode.add_group(state.finish());
        episode.create_dataset("actions").with_f32_data(&vec![0.1; n]).with_shape(&[n as u64, 1]);
        episode.create_dataset("rewards").with_f64_data(&vec![1.0; n]);
        episode.create_dataset("terminations").with_u8_data(&vec![0; n]);
        episode.create_dataset("truncations").with_u8_data(&vec![0; n]);
        file.add_group(episode.finish());
    }
    file.finish().expect("a small file")
}

/// Two demonstrations in robomimic's layout, without `next_obs`.
fn robomimic_demonstrations() -> Vec<u8> {
    let mut file = FileBuilder::new();
    let mut data = file.create_group("data");
    for name in ["demo_0", "demo_1"] {
        let mut demo = data.create_group(name);
        let mut state = demo.create_group("obs");
        state.create_dataset("joint").with_f32_data(&[0.5; 8]).with_shape(&[4, 2]);
        demo.add_group(state.finish());
        demo.create_dataset("actions").with_f32_data(&[0.1; 4]).with_shape(&[4, 1]);
        demo.create_dataset("dones").with_u8_data(&[0, 0, 0, 1]);
        data.add_group(demo.finish());
    }
    file.add_group(data.finish());
    file.finish().expect("a small file")
}

#[test]
fn fuzz_npz() {
    fuzz("npz", seeds(&["linear.npz", "gaussian.npz"]), 300, |_, path| drop(load_npz(path)));
}

#[test]
fn fuzz_safetensors() {
    let exhibit = Exhibit::all().remove(0);
    let small = |prefix: &str| {
        let mut parameters = NamedParameters::default();
        parameters.tensors.insert(format!("{prefix}.w"), (vec![1, 3, 2], vec![0.5; 6]));
        parameters.metadata = exhibit.parameters().unwrap().metadata;
        parameters
    };
    let policy = exhibit.parameters().unwrap().to_half_bytes();
    let seeds = vec![small("score").to_bytes(), small("policy").to_half_bytes(), policy, sequence_policy()];
    fuzz("safetensors", seeds, 16, |bytes, path| {
        if let Ok(parameters) = NamedParameters::from_bytes(bytes, path) {
            let _ = Card::of(&parameters, path);
            let _ = Policy::from_parameters(&parameters, path);
            let _ = ScoreModel::from_parameters(&parameters, path, &cpu());
        }
    });
}

/// The smallest policy with a memory.
fn sequence_policy() -> Vec<u8> {
    let mut t = Transitions::new(1, 1);
    t.push(&[0.0], &[0.0], 1.0, &[0.0], false, true);
    let (streams, standardizer) = (Streams::new(0), Standardizer::identity(1));
    let member = Member { streams, parts: vec![Arc::new(t)], standardizer, reward_scale: 1.0, row_scores: None };
    let buffer = Buffer::new(vec![member], 1).unwrap();
    let mut config = MetaDtConfig { embed: 2, layers: 1, timesteps: 2, ..MetaDtConfig::default() };
    (config.world_model.features, config.world_model.gru, config.world_model.latent) = (1, 1, 1);
    config.world_model.steps = 0;
    let learner = MetaDt::new(&buffer, &config, Place::NONE, &cpu()).unwrap().unwrap();
    learner.policies()[0].to_parameters().to_bytes()
}

#[test]
fn fuzz_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let mut checkpoints = Checkpoints::open(dir.path(), "seed", "key").unwrap();
    let mut state = NamedParameters::default();
    state.tensors.insert("0/x".into(), (vec![2, 2], vec![1.0; 4]));
    checkpoints.keep(7, state).unwrap();
    let sealed = std::fs::read(dir.path().join("seed.1.checkpoint")).unwrap();
    let inside = sealed[sealed.iter().position(|b| *b == b'\n').unwrap() + 1..].to_vec();
    let place = dir.path().join("again.0.checkpoint");
    fuzz("checkpoint", vec![inside, sealed], 32, |bytes, _| {
        // As it is, and with a seal that fits, because a seal keeps everything else out.
        std::fs::write(&place, bytes).unwrap();
        let _ = Checkpoints::open(dir.path(), "again", "key").unwrap().restore();
        write_sealed(&place, "key", bytes).unwrap();
        let _ = Checkpoints::open(dir.path(), "again", "key").unwrap().restore();
    });
}

#[test]
fn fuzz_toml() {
    fuzz("toml", seeds(&["sweep.toml", "config.toml"]), 2000, |_, path| {
        let _ = Layered::new(Preset::Default, None, None, Some(path), &[]).and_then(|l| l.config());
        let _ = Manifest::plan(path);
    });
}

#[test]
fn fuzz_manifest() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds/sweep.toml");
    let text = Manifest::plan(&folder).unwrap().to_jsonl();
    let short: String = text.lines().take(3).map(|l| format!("{l}\n")).collect();
    fuzz("manifest", vec![text.into_bytes(), short.into_bytes()], 64, |bytes, path| {
        let text = String::from_utf8_lossy(bytes);
        if let Ok(manifest) = Manifest::parse(&text, path) {
            manifest.entries.iter().for_each(|e| drop(manifest.config(e)));
        }
    });
}
