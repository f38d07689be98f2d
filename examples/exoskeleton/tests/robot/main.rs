//! The built program in real use: real processes, real time. The tests assert no times.

mod overload;
mod real_time;
mod secured;
mod sockets;
mod stop;
mod up;

use std::path::Path;
use std::process::{Child, Command, Output};

use sinew_robot_tests::process;
pub(crate) use sinew_robot_tests::process::{DEADLINE, SOCKETS, alone, end, folder};

const PROGRAM: &str = env!("CARGO_BIN_EXE_exoskeleton");

fn start(folder: &Path, arguments: &[&str]) -> Child {
    process::start(PROGRAM, folder, arguments, &[])
}

/// The names of the folders in memory with the journals of the robot that this launcher has started.
fn journals(launcher: u32) -> Vec<String> {
    let prefix = format!("sinew-exoskeleton-{launcher}-");
    // Without `/dev/shm` they are in the folder of the test, which is removed.
    let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.filter(|name| name.starts_with(&prefix)).collect()
}

/// Runs `sinew`, which another package builds into the same directory, in the folder of a test.
fn sinew(folder: &Path, words: &[&str]) -> Output {
    let test = std::env::current_exe().expect("a test has a path");
    let program =
        test.parent().and_then(Path::parent).expect("it lies in deps/ of the profile's").join("sinew");
    assert!(program.exists(), "there is no {}; build it: cargo build -p sinew-cli", program.display());
    let mut command = Command::new(program);
    command.args(words).current_dir(folder).env("XDG_RUNTIME_DIR", folder).env_remove("SINEW_SOCKET");
    command.output().expect("the command starts")
}
