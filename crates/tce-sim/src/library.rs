//! libmujoco, opened when the simulator is first used.
//!
//! Commands that need no simulator run without MuJoCo, and a copied program finds the library next to itself.
//! `mujoco-rs` calls MuJoCo's functions by name and expects the linker to find them. They are defined here: each is a
//! function that jumps to an address, and [`open`] fills in the addresses. Unlike assembler trampolines, these
//! functions work on any processor, and the compiler checks their signatures against those of `mujoco-rs`. This does
//! not work for data tables exported by MuJoCo, but `mujoco-rs` uses none.
//!
//! If a function is missing from the list, linking a binary fails: `undefined symbol: mj_...`. Add it.

use std::env;
use std::ffi::{CStr, c_char, c_int, c_void};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, PoisonError};

use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
use mujoco_rs::mujoco_c::{mjData, mjLogConfig, mjModel, mjVFS, mjfLogHandler, mjtNum};

use crate::SimError;
use crate::error::{FILE, LibraryError, VARIABLE, VERSION};

/// The folder where the build script stored the library: for `cargo run`, tests and benches.
const BUILT_WITH: Option<&str> = option_env!("TCE_MUJOCO_BUILD_DIR");

/// Opens libmujoco, unless it is already open, and returns its path.
///
/// The path is that in `TCE_MUJOCO_LIB`. If this is not set, the search order is: next to the program, in `../lib`
/// relative to it, in the build script's folder, and in the search path of the system's loader (`LD_LIBRARY_PATH`). The
/// first file found is used, even if it is unusable.
///
/// # Errors
/// If there is no library, or if it is not MuJoCo 3.17.0.
pub fn open() -> Result<PathBuf, SimError> {
    static OPENED: Mutex<Option<PathBuf>> = Mutex::new(None);
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(path) = &*opened {
        return Ok(path.clone());
    }
    // Without AVX, MuJoCo would crash the process with an illegal instruction.
    #[cfg(target_arch = "x86_64")]
    if !is_x86_feature_detected!("avx") {
        return Err(LibraryError::Processor.into());
    }
    let path = find()?;
    load(&path)?;
    Ok(opened.insert(path).clone())
}

/// The path of the library to use. If no file is found, it is the bare name, which leaves the search to the system.
fn find() -> Result<PathBuf, LibraryError> {
    if let Some(path) = env::var_os(VARIABLE).filter(|v| !v.is_empty()) {
        let path = PathBuf::from(path);
        // The loader does not search for a path that contains a folder.
        let absolute = std::path::absolute(&path).unwrap_or_else(|_| path.clone());
        return if absolute.is_file() { Ok(absolute) } else { Err(LibraryError::Named { path }) };
    }
    let places = places(env::current_exe().ok().as_deref());
    if let Some(found) = places.iter().find(|p| p.is_file()) {
        return Ok(found.clone());
    }
    // SAFETY: MuJoCo's initialisers register its decoders and touch none of our data.
    if unsafe { Library::open(Some(FILE), RTLD_NOW | RTLD_LOCAL) }.map(std::mem::forget).is_ok() {
        return Ok(PathBuf::from(FILE));
    }
    let mut text = format!("  {VARIABLE}: not set\n");
    for place in places {
        let _ = writeln!(text, "  {}", place.display());
    }
    text += "  the system's loader (LD_LIBRARY_PATH, ldconfig)\n";
    Err(LibraryError::Missing { places: text })
}

/// Candidate paths for the program `program`.
fn places(program: Option<&Path>) -> Vec<PathBuf> {
    let beside = program.and_then(Path::parent);
    let lib = beside.and_then(Path::parent).map(|prefix| prefix.join("lib"));
    let folders = [beside.map(Path::to_owned), lib, BUILT_WITH.map(PathBuf::from)];
    folders.into_iter().flatten().map(|folder| folder.join(FILE)).collect()
}

/// Opens `path` permanently and reads the function addresses from it.
fn load(path: &Path) -> Result<(), LibraryError> {
    let unusable = |reason: String| LibraryError::Unusable { path: path.to_owned(), reason };
    let system = |e: libloading::Error| {
        let detail = std::error::Error::source(&e).map_or_else(|| e.to_string(), ToString::to_string);
        unusable(detail)
    };
    // SAFETY: MuJoCo's initialisers register its decoders and touch none of our data.
    let library = unsafe { Library::open(Some(path), RTLD_NOW | RTLD_LOCAL) }.map_err(system)?;
    // SAFETY: this is the function's type in every version of MuJoCo, and it returns a constant string.
    let found = unsafe {
        let version = library.get::<unsafe extern "C" fn() -> *const c_char>(c"mj_versionString".to_bytes_with_nul());
        CStr::from_ptr((version.map_err(system)?)()).to_string_lossy().into_owned()
    };
    if found != VERSION {
        return Err(LibraryError::Version { path: path.to_owned(), found });
    }
    FUNCTIONS.fill(&library).map_err(system)?;
    // The addresses stay valid until the process ends.
    std::mem::forget(library);
    Ok(())
}

/// Initial entry of the table, until [`open`] has filled it.
extern "C" fn closed() -> ! {
    eprintln!("MuJoCo was called before it was opened: a fault of this program (see tce-sim/src/library.rs)");
    std::process::abort()
}

/// Defines the table of addresses and the functions that jump to these addresses.
macro_rules! forward {
    ($(fn $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?;)*) => {
        /// The addresses of MuJoCo's functions.
        #[expect(non_snake_case, reason = "C's names")]
        struct Functions {
            $($name: AtomicPtr<c_void>,)*
        }

        static FUNCTIONS: Functions = Functions {
            $($name: AtomicPtr::new(closed as extern "C" fn() -> ! as *mut c_void),)*
        };

        impl Functions {
            fn fill(&self, library: &Library) -> Result<(), libloading::Error> {
                $(
                    // SAFETY: only the address is taken here.
                    let address = unsafe { library.get::<*mut c_void>(concat!(stringify!($name), "\0").as_bytes())? };
                    self.$name.store(address.as_raw_ptr(), Ordering::Relaxed);
                )*
                Ok(())
            }
        }

        $(
            // Compiles only if the type is the same as in the bindings.
            const _: unsafe extern "C" fn($($type),*) $(-> $result)? = mujoco_rs::mujoco_c::$name;

            /// MuJoCo's function of this name.
            #[unsafe(no_mangle)]
            unsafe extern "C" fn $name($($argument: $type),*) $(-> $result)? {
                // A relaxed load is enough: every caller has gone through the lock in `open`.
                let address = FUNCTIONS.$name.load(Ordering::Relaxed);
                // SAFETY: this is the address of the C function of the same name in MuJoCo 3.17.0, for which the
                // bindings were made; or `closed`, which takes no arguments and does not return.
                unsafe {
                    let function: unsafe extern "C" fn($($type),*) $(-> $result)? = std::mem::transmute(address);
                    function($($argument),*)
                }
            }
        )*
    };
}

forward! {
    fn mj_addBufferVFS(vfs: *mut mjVFS, name: *const c_char, buffer: *const c_void, size: c_int) -> c_int;
    fn mj_defaultVFS(vfs: *mut mjVFS);
    fn mj_deleteData(data: *mut mjData);
    fn mj_deleteModel(model: *mut mjModel);
    fn mj_deleteVFS(vfs: *mut mjVFS);
    fn mj_forward(model: *const mjModel, data: *mut mjData);
    fn mj_getTotalmass(model: *const mjModel) -> mjtNum;
    fn mj_id2name(model: *const mjModel, kind: c_int, id: c_int) -> *const c_char;
    fn mj_kinematics(model: *const mjModel, data: *mut mjData);
    fn mj_loadXML(file: *const c_char, vfs: *const mjVFS, error: *mut c_char, size: c_int) -> *mut mjModel;
    fn mj_makeData(model: *const mjModel) -> *mut mjData;
    fn mj_name2id(model: *const mjModel, kind: c_int, name: *const c_char) -> c_int;
    fn mj_resetData(model: *const mjModel, data: *mut mjData);
    fn mj_step(model: *const mjModel, data: *mut mjData);
    fn mj_version() -> c_int;
    fn mj_versionString() -> *const c_char;
    fn mju_getLogConfig() -> mjLogConfig;
    fn mju_setLogConfig(config: mjLogConfig);
    fn mju_setLogHandler(handler: mjfLogHandler) -> mjfLogHandler;
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use super::*;

    #[test]
    fn a_program_looks_beside_itself_and_in_the_lib_of_its_prefix() {
        let places = places(Some(Path::new("/opt/tce/bin/tce")));
        assert_eq!(places[0], Path::new("/opt/tce/bin/libmujoco.so.3.17.0"));
        assert_eq!(places[1], Path::new("/opt/tce/lib/libmujoco.so.3.17.0"));
        assert!(places[2].is_file(), "the build's own: {}", places[2].display());
    }

    #[test]
    fn a_file_that_is_no_library_is_named_with_what_the_system_says() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        let message = load(&path).unwrap_err().to_string();
        assert!(message.contains("Cargo.toml: this is not a MuJoCo"), "{message}");
        assert!(message.contains("invalid ELF header"), "{message}");
    }

    #[test]
    fn the_library_is_opened_once_and_is_where_it_was() {
        let first = open().unwrap();
        assert_eq!(first.file_name(), Some(OsStr::new(FILE)));
        assert_eq!(open().unwrap(), first);
        // SAFETY: the function takes no arguments and returns a number.
        assert_eq!(unsafe { mj_version() }, 3_017_000);
    }
}
