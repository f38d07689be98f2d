//! The stack frames of a panic that are useful to its reader: those of the program's own code.

use std::{backtrace::Backtrace, sync::OnceLock};

/// Maximum number of frames of the program's own code that are shown, from the panic outwards.
const SHOWN_MAX: usize = 10;

/// The crates between an application's code and its thread.
const LIBRARIES: [&str; 11] = [
    "std",
    "core",
    "alloc",
    "__rustc",
    "test",
    "tokio",
    "tokio_util",
    "actix",
    "actix_rt",
    "futures_core",
    "futures_util",
];

/// The packages of Sinew, and the folders of their sources.
const SINEW: [(&str, &str); 15] = [
    ("sinew", "actors/src/"),
    ("sinew_c", "bindings/c/src/"),
    ("sinew_client", "actors/client/src/"),
    ("sinew_gncl", "actors/gncl/src/"),
    ("sinew_lncl", "actors/lncl/src/"),
    ("sinew_model", "actors/model/src/"),
    ("sinew_ndl", "actors/ndl/src/"),
    ("sinew_node", "actors/node/src/"),
    ("sinew_protocol", "actors/protocol/src/"),
    ("sinew_replay", "actors/replay/src/"),
    ("sinew_runtime", "runtime/src/"),
    ("sinew_security", "actors/security/src/"),
    ("sinew_session", "actors/session/src/"),
    ("sinew_shm", "runtime/shm/src/"),
    ("sinew_sync", "actors/sync/src/"),
];

/// Path fragments of files that are not the program's own: the standard library's, and those of crates from a registry.
const FOREIGN_PATHS: [&str; 4] = ["/rustc/", "/registry/src/", "/library/std/src/", "/library/core/src/"];

/// Functions of the C library at the bottom of every thread; their file is known if debug information is
/// installed.
const C_STARTS: [&str; 4] = ["start_thread", "clone", "__libc_start", "_start"];

/// The frames of a panic that are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Frames {
    None,
    /// The frames of the program's own code.
    Own,
    All,
}

impl Frames {
    /// Returns the setting of the environment: `RUST_BACKTRACE=0` for none, `full` for all.
    pub(super) fn wanted() -> Self {
        static WANTED: OnceLock<Frames> = OnceLock::new();
        *WANTED.get_or_init(|| match std::env::var("RUST_BACKTRACE").as_deref() {
            Ok("0") => Self::None,
            Ok("full") => Self::All,
            Ok(_) | Err(_) => Self::Own,
        })
    }
}

/// Returns one line per frame. Resolves names, which may take long at the first time in a process.
pub(super) fn frames(backtrace: &Backtrace, wanted: Frames) -> Vec<String> {
    match wanted {
        Frames::None => Vec::new(),
        Frames::All => vec![format!("{backtrace:#}")],
        Frames::Own => own(&backtrace.to_string(), &Homes::of_sinew()),
    }
}

/// The directories of Sinew's sources, which may be inside the program's own.
struct Homes {
    folders: Vec<String>,
    /// The working directory, which the standard library omits from paths.
    here: String,
}

impl Homes {
    fn of_sinew() -> Self {
        let runtime = env!("CARGO_MANIFEST_DIR");
        let root = runtime.strip_suffix("/runtime").unwrap_or(runtime);
        let folders = SINEW.map(|(_, folder)| format!("{root}/{folder}"));
        let here = std::env::current_dir().unwrap_or_default();
        Self { folders: folders.into(), here: here.to_string_lossy().into_owned() }
    }

    fn are_of(&self, file: &str) -> bool {
        let whole = file.strip_prefix("./").map(|rest| format!("{}/{rest}", self.here));
        let file = whole.as_deref().unwrap_or(file);
        self.folders.iter().any(|folder| file.starts_with(folder))
    }
}

/// Returns the frames of the program's own code from the standard library's text of a backtrace. That text
/// has a line `  4: name` per frame, and a line `at file:line:column` if the location is known.
fn own(written: &str, sinew: &Homes) -> Vec<String> {
    let mut shown: Vec<String> = Vec::new();
    let mut lines = written.lines().peekable();
    while let Some(line) = lines.next() {
        let Some((_, name)) = line.split_once(": ") else { continue };
        let at = lines.next_if(|next| next.trim_start().starts_with("at "));
        let file = at.map(|at| at.trim_start().trim_start_matches("at "));
        if shown.len() < SHOWN_MAX && is_own(name, file, sinew) {
            let file = file.map(|file| format!(" ({})", file.trim_start_matches("./")));
            shown.push(format!("      at {name}{}", file.unwrap_or_default()));
        }
    }
    shown
}

fn is_own(name: &str, file: Option<&str>, sinew: &Homes) -> bool {
    let is_foreign = |file: &str| FOREIGN_PATHS.iter().any(|part| file.contains(part)) || sinew.are_of(file);
    match (crate_of(name), file) {
        (Some(library), _) if LIBRARIES.contains(&library) => false,
        (Some(library), _) if SINEW.iter().any(|(package, _)| *package == library) => false,
        (None, _) if C_STARTS.iter().any(|start| name.starts_with(start)) => false,
        (_, Some(file)) => !is_foreign(file),
        // A name of the C library, such as `start_thread`.
        (found, None) => found.is_some(),
    }
}

/// Returns the crate at the beginning of a function's name: `hip` of `<hip::Hip as actix::Handler<Torque>>::handle`.
fn crate_of(name: &str) -> Option<&str> {
    let start = name.trim_start_matches(['<', '&', '(', '*', '[']);
    let start =
        ["mut ", "dyn ", "const "].into_iter().fold(start, |start, word| start.trim_start_matches(word));
    let (found, _) = start.split_once("::")?;
    found.chars().all(|part| part.is_alphanumeric() || part == '_').then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    const WRITTEN: &str = "   0: std::backtrace_rs::backtrace::trace
             at /rustc/59807/library/std/src/../../backtrace/src/backtrace/mod.rs:66:14
   1: sinew_runtime::supervision::panics::hook
             at ./runtime/src/supervision/panics.rs:130:5
   2: core::panicking::panic_fmt
             at /rustc/59807/library/core/src/panicking.rs:80:14
   3: hip::gait::phase
             at ./src/gait.rs:12:9
   4: <hip::Hip as actix::handler::Handler<sinew_runtime::app::Delivery<hip::Torque>>>::handle
             at /robot/src/main.rs:42:5
   5: {closure#0}
             at /home/me/robot/vendor/sinew/runtime/src/app/drive.rs:57:11
   6: {closure#1}
             at ./src/main.rs:50:11
   7: <core::panic::unwind_safe::AssertUnwindSafe<hip::main::{closure#0}> as core::ops::function::FnOnce<()>>::call_once
   8: call_once<hip::main::{closure_env#0}, ()>
             at /rustc/59807/library/core/src/ops/function.rs:250:5
   9: nalgebra::base::solve
             at /home/me/.cargo/registry/src/index.crates.io-1949/nalgebra-0.33.0/src/base.rs:7:1
  10: start_thread
             at nptl/pthread_create.c:442:8
  11: <unknown>
";

    fn homes() -> Homes {
        Homes {
            folders: vec!["/home/me/robot/vendor/sinew/runtime/src/".to_owned()],
            here: "/robot".to_owned(),
        }
    }

    #[test]
    fn only_the_programs_own_code_is_shown() {
        let handle =
            "<hip::Hip as actix::handler::Handler<sinew_runtime::app::Delivery<hip::Torque>>>::handle";
        let wanted = [
            "      at hip::gait::phase (src/gait.rs:12:9)".to_owned(),
            format!("      at {handle} (/robot/src/main.rs:42:5)"),
            "      at {closure#1} (src/main.rs:50:11)".to_owned(),
        ];
        assert_eq!(own(WRITTEN, &homes()), wanted);
    }

    #[test]
    fn sinew_in_a_program_folder_is_not_own_code() {
        let homes =
            Homes { folders: vec!["/robot/sinew/runtime/src/".to_owned()], here: "/robot".to_owned() };
        assert!(homes.are_of("./sinew/runtime/src/app/drive.rs") && !homes.are_of("./src/main.rs"));
    }

    #[test]
    fn number_of_shown_frames_is_limited() {
        let frame = |number: usize| format!("  {number}: hip::deep\n             at ./src/deep.rs:1:1\n");
        let written: String = (0..100).map(frame).collect();
        assert_eq!(own(&written, &homes()).len(), SHOWN_MAX);
    }
}
