//! The library's log on the standard error of programs in C.

use std::io::{PipeReader, PipeWriter, Write, pipe};

use rustix::io::ioctl_fionbio;
use sinew::{Endpoint, Registration, message::Kind};

use super::{
    ground::{C, Ground, WATCHDOG, endpoint, is_there},
    resolve,
};

#[test]
fn sinew_log_sets_the_level_on_stderr() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let greeter = C.shared("examples/greeter.c", &ground);
    let mut greeter = ground.start_under(&["env", "SINEW_LOG=debug"], &greeter, &[]);
    greeter.wait_for(&["registered", "knee"]);
}

/// A full pipe, with its end that is never read.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (unread, mut full) = pipe().expect("the system has a pipe");
    ioctl_fionbio(&full, true).expect("it is ours");
    while full.write(&[b'.'; 4_096]).is_ok() {}
    ioctl_fionbio(&full, false).expect("it is ours");
    (unread, full)
}

#[test]
fn unread_stderr_blocks_no_call() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let (_unread, full) = full_pipe();
    let mut greeter = ground.start_logging_to(full, &C.shared("examples/greeter.c", &ground));
    greeter.wait_for(&["the greeter is there"]);
    let mut asking = endpoint(&ground, Registration::new());
    assert_eq!(ask_for_a_greeting(&mut asking), b"Hello, Ankle");
    assert_eq!(greeter.wait_for_exit(), Some(0));
}

fn ask_for_a_greeting(asking: &mut Endpoint) -> Vec<u8> {
    let to = resolve(asking, "greeter");
    let mut name = asking.create_message(to, Kind::named("demo.name"), 5).expect("it is short");
    name.copy_from_slice(b"Ankle");
    asking.loaned(name).ask_raw(WATCHDOG).expect("the greeter answers").bytes().to_vec()
}

#[test]
fn closed_stderr_is_not_confused_with_a_socket() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let under = ["env", "SINEW_LOG=debug", "sh", "-c", r#"exec "$@" 2>&-"#, "sh"];
    let mut greeter = ground.start_under(&under, &C.shared("examples/greeter.c", &ground), &[]);
    greeter.wait_for(&["the greeter is there"]);
    let mut asking = endpoint(&ground, Registration::new());
    assert_eq!(ask_for_a_greeting(&mut asking), b"Hello, Ankle");
    assert_eq!(greeter.wait_for_exit(), Some(0));
}
