//! Downloads libmujoco 3.17.0: extracts it from the `mujoco` wheel on PyPI, checks it against a pinned SHA-256, and
//! stores it in `third_party/mujoco/` of the workspace (ignored by git).
//!
//! Nothing is linked with it: `src/library.rs` opens it when the simulator is first used, and searches, among other
//! places, the folder that this script passes to it. `mujoco-rs` has its own build script, which only needs a file
//! named `libmujoco.so` in `MUJOCO_DYNAMIC_LINK_DIR` (`.cargo/config.toml`): the empty linker script in `link/`.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use sha2::{Digest, Sha256};

const VERSION: &str = "3.17.0";
const LIBRARY: &str = "libmujoco.so.3.17.0";

/// One platform of the wheel. The wheels for CPython 3.10 to 3.14 contain the same library file. One of them is fixed
/// here, so that the download does not depend on the installed Python.
struct Platform {
    os: &'static str,
    arch: &'static str,
    wheel_tag: &'static str,
    sha256: &'static str,
}

const PLATFORMS: [Platform; 2] = [
    Platform {
        os: "linux",
        arch: "x86_64",
        wheel_tag: "manylinux_2_28_x86_64",
        sha256: "23496b023ee80fb61ab71167e94bc649f9941710fde96b18bb8204fb332523ad",
    },
    Platform {
        os: "linux",
        arch: "aarch64",
        wheel_tag: "manylinux_2_28_aarch64",
        sha256: "e2edd0204fb9229f75f332a4fcd1a32345bb9f90651dc0fddfa20ec0670db789",
    },
];

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=TCE_MUJOCO_LIB");
    println!("cargo::rerun-if-env-changed=DOCS_RS");
    if env::var_os("DOCS_RS").is_some() {
        return;
    }
    match library_dir() {
        Ok(dir) => {
            println!("cargo::rerun-if-changed={}", dir.join(LIBRARY).display());
            println!("cargo::rustc-env=TCE_MUJOCO_BUILD_DIR={}", dir.display());
        }
        Err(message) => {
            // Cargo shows these lines without a panic message.
            for line in message.lines() {
                println!("cargo::error={line}");
            }
        }
    }
}

/// The directory that contains [`LIBRARY`]; downloads it if necessary.
fn library_dir() -> Result<PathBuf, String> {
    let os = env::var("CARGO_CFG_TARGET_OS").unwrap_or_default();
    let arch = env::var("CARGO_CFG_TARGET_ARCH").unwrap_or_default();
    let platform = PLATFORMS.iter().find(|p| p.os == os && p.arch == arch);
    if let Some(path) = env::var_os("TCE_MUJOCO_LIB") {
        return own_library(Path::new(&path), platform);
    }
    let Some(platform) = platform else {
        return Err(format!(
            "MuJoCo {VERSION}: no pinned library for {os} on {arch} (known: linux on x86_64 and aarch64).\n\
             Set TCE_MUJOCO_LIB=/path/to/{LIBRARY} to use one of your own."
        ));
    };

    let manifest = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let workspace = manifest.ancestors().nth(2).expect("the crate lies in crates/ of the workspace").to_owned();
    let dir = workspace.join("third_party/mujoco").join(format!("{VERSION}-{os}-{arch}"));
    let library = dir.join(LIBRARY);
    if library.is_file() {
        let found = sha256(&library)?;
        if found == platform.sha256 {
            return Ok(dir);
        }
        return Err(format!(
            "{} is not the MuJoCo library it should be: SHA-256 {found}, expected {}.\n\
             Delete it and build again (it is then fetched anew), or set TCE_MUJOCO_LIB=/path/to/{LIBRARY}.",
            library.display(),
            platform.sha256
        ));
    }
    fetch(platform, &dir).map_err(|e| {
        format!(
            "MuJoCo {VERSION} (the PyPI package `mujoco`) could not be fetched: {e}\n\
             What to do: (1) install Python 3 with pip and build again with network access to PyPI (or a mirror that \
             pip is configured for); or (2) fetch the wheel elsewhere with `pip download --no-deps \
             --only-binary=:all: --platform {} mujoco=={VERSION}`, unzip mujoco/{LIBRARY} out of it, and put it at \
             {} or set TCE_MUJOCO_LIB=/path/to/{LIBRARY}.",
            platform.wheel_tag,
            library.display()
        )
    })?;
    Ok(dir)
}

/// The library that the user specifies in `TCE_MUJOCO_LIB`.
fn own_library(path: &Path, platform: Option<&Platform>) -> Result<PathBuf, String> {
    let named_right = path.file_name().is_some_and(|n| n == LIBRARY);
    if !path.is_absolute() || !named_right || !path.is_file() {
        return Err(format!(
            "TCE_MUJOCO_LIB is `{}`, expected the absolute path of an existing file named {LIBRARY}",
            path.display()
        ));
    }
    if platform.is_some_and(|p| sha256(path).is_ok_and(|found| found != p.sha256)) {
        println!(
            "cargo::warning=TCE_MUJOCO_LIB ({}) is not PyPI's build of MuJoCo {VERSION}; results may differ in the \
             last bits from those of the pinned library",
            path.display()
        );
    }
    Ok(path.parent().expect("an absolute path of a file").to_owned())
}

/// Downloads the wheel, extracts the library, checks it and moves it into place. Works in a directory of this process
/// and ends with a rename, so that parallel builds do not disturb each other.
fn fetch(platform: &Platform, dir: &Path) -> Result<(), String> {
    let parent = dir.parent().expect("third_party/mujoco");
    fs::create_dir_all(dir).map_err(|e| format!("cannot create {}: {e}", dir.display()))?;
    let work = parent.join(format!(".fetch-{}", std::process::id()));
    fs::create_dir_all(&work).map_err(|e| format!("cannot create {}: {e}", work.display()))?;
    let result = fetch_in(platform, &work, &dir.join(LIBRARY));
    let _ = fs::remove_dir_all(&work);
    result
}

fn fetch_in(platform: &Platform, work: &Path, target: &Path) -> Result<(), String> {
    let mut download = python()?;
    download.args(["-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]);
    download.args(["--only-binary=:all:", "--implementation", "cp", "--python-version", "3.12", "--abi", "cp312"]);
    download.args(["--platform", platform.wheel_tag, "--dest"]).arg(work).arg(format!("mujoco=={VERSION}"));
    run(&mut download)?;

    let wheel = fs::read_dir(work)
        .map_err(|e| format!("cannot list {}: {e}", work.display()))?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .find(|path| path.extension().is_some_and(|x| x == "whl"))
        .ok_or_else(|| format!("pip ended well but left no wheel in {}", work.display()))?;
    let library = work.join(LIBRARY);
    let mut unpack = python()?;
    unpack
        .arg("-c")
        .arg("import sys, zipfile; open(sys.argv[3], 'wb').write(zipfile.ZipFile(sys.argv[1]).read(sys.argv[2]))");
    unpack.arg(&wheel).arg(format!("mujoco/{LIBRARY}")).arg(&library);
    run(&mut unpack)?;

    let found = sha256(&library)?;
    if found != platform.sha256 {
        return Err(format!(
            "checksum mismatch: {LIBRARY} out of {} has SHA-256 {found}, expected {}; it is not used (is a mirror of \
             PyPI or a local wheel in the way?)",
            wheel.file_name().unwrap_or_default().display(),
            platform.sha256
        ));
    }
    fs::rename(&library, target).map_err(|e| format!("cannot rename into {}: {e}", target.display()))
}

/// The first Python 3 in the search path.
fn python() -> Result<Command, String> {
    for name in ["python3", "python"] {
        let is_3 = Command::new(name).args(["-c", "import sys; sys.exit(sys.version_info[0] != 3)"]).output();
        if is_3.is_ok_and(|o| o.status.success()) {
            return Ok(Command::new(name));
        }
    }
    Err("there is no Python 3 (`python3` or `python`) on the path".to_owned())
}

fn run(command: &mut Command) -> Result<(), String> {
    let output = command.output().map_err(|e| format!("cannot run {command:?}: {e}"))?;
    if output.status.success() {
        return Ok(());
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = stderr.lines().filter(|l| !l.trim().is_empty()).collect();
    Err(format!("{command:?} failed:\n{}", lines[lines.len().saturating_sub(6)..].join("\n")))
}

fn sha256(path: &Path) -> Result<String, String> {
    let bytes = fs::read(path).map_err(|e| format!("cannot read {}: {e}", path.display()))?;
    Ok(Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect())
}
