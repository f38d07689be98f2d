//! What a person reads of a panic where nobody subscribes to the log: the program that panics is this one, started once more.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod reader;
#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::{process::Command, sync::mpsc::sync_channel};

use actix::{Actor, Handler};
use reader::Reader;
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    log,
    supervision::Reason,
};
use stage::{DEADLINE, Number, Stage};

/// Set in the program that panics.
const INNER: &str = "SINEW_TEST_INNER";

struct Fragile;

impl Actor for Fragile {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Fragile {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, _: &mut Self::Context) {
        panic!("this is to be read");
    }
}

fn panic_once() {
    let stage =
        Stage::start(vec![AppSpec::new("fragile", || Fragile).handles::<Number>().own_thread().into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    assert!(matches!(stage.wait_failed(0), Reason::Panic(_)));
    log::flush(DEADLINE);
}

/// What this program says on its standard error when it plays its part in this test, with these variables set.
fn said(test: &str, variables: &[(&str, &str)]) -> String {
    let mut inner = Command::new(std::env::current_exe().unwrap());
    inner.args([test, "--exact", "--nocapture"]).env_remove("RUST_LOG").env_remove("SINEW_LOG");
    inner.env_remove("RUST_BACKTRACE").env(INNER, "1").envs(variables.iter().copied());
    let output = inner.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stderr).unwrap()
}

fn is_inner() -> bool {
    std::env::var_os(INNER).is_some()
}

fn count(text: &str, what: &str) -> usize {
    text.matches(what).count()
}

#[test]
fn a_panic_is_said_once_with_actor_place_and_own_frames() {
    if is_inner() {
        return panic_once();
    }
    let test = "a_panic_is_said_once_with_actor_place_and_own_frames";
    for (variables, frames) in [
        (&[][..], 1..=10),
        (&[("RUST_BACKTRACE", "1")], 1..=10),
        (&[("RUST_BACKTRACE", "0")], 0..=0),
        // Who turns the log off learns of panics all the same.
        (&[("SINEW_LOG", "off")], 1..=10),
    ] {
        let text = said(test, variables);
        assert_eq!(count(&text, "the actor 'fragile' on thread "), 1, "{text}");
        assert_eq!(count(&text, "panicked at runtime/tests/backtraces.rs:"), 1, "{text}");
        assert_eq!(count(&text, "panicked at"), 1, "no other place: {text}");
        assert_eq!(count(&text, "this is to be read"), 1, "{text}");
        let shown: Vec<_> = text.lines().filter(|line| line.starts_with("      at ")).collect();
        assert!(frames.contains(&shown.len()), "{text}");
        assert!(shown.iter().all(|frame| frame.contains("backtraces.rs")), "its own code alone: {text}");
        assert_eq!(count(&text, "stack backtrace:"), 0, "not the standard hook as well: {text}");
    }
    let text = said(test, &[("RUST_BACKTRACE", "full")]);
    assert!(count(&text, "sinew_runtime::") > 3, "all frames: {text}");
}

#[test]
fn a_hook_of_the_programs_own_that_captures_nothing_is_not_taken_for_the_standard_one() {
    if is_inner() {
        std::panic::set_hook(Box::new(|info| {
            eprintln!("MINE: {}", info.payload_as_str().unwrap_or_default());
        }));
        return panic_once();
    }
    let test = "a_hook_of_the_programs_own_that_captures_nothing_is_not_taken_for_the_standard_one";
    let text = said(test, &[("RUST_BACKTRACE", "0")]);
    assert_eq!(count(&text, "MINE: the actor 'fragile' on thread "), 1, "{text}");
    assert_eq!(count(&text, "this is to be read"), 1, "{text}");
}

#[test]
fn a_panic_of_a_thread_of_the_programs_own_is_said_by_the_standard_hook_alone() {
    if is_inner() {
        panic_once();
        let _ = std::thread::spawn(|| panic!("of the program's own")).join();
        return log::flush(DEADLINE);
    }
    let test = "a_panic_of_a_thread_of_the_programs_own_is_said_by_the_standard_hook_alone";
    let text = said(test, &[("RUST_BACKTRACE", "0")]);
    assert_eq!(count(&text, "of the program's own"), 1, "{text}");
    assert!(text.contains("thread '<unnamed>'"), "{text}");
}

#[test]
fn without_a_subscriber_lines_go_to_the_standard_error_and_a_later_subscriber_has_all() {
    if is_inner() {
        log::warn!(target: "sinew::test", node = "hip", "before");
        log::debug!(target: "sinew::test", "in detail");
        log::flush(DEADLINE);
        let (read, lines) = sync_channel(100);
        let reader = Reader { wants: |_| true, read, may_go_on: None };
        tracing::subscriber::set_global_default(reader).expect("the place is free");
        log::warn!(target: "sinew::test", "after");
        log::debug!(target: "sinew::test", "in detail");
        log::here!(warn: target: "sinew::test", "on this thread");
        log::flush(DEADLINE);
        let read: Vec<_> = lines.try_iter().collect();
        // The direct one does not wait for the log's thread.
        assert_eq!(read.len(), 3, "{read:?}");
        return;
    }
    let test = "without_a_subscriber_lines_go_to_the_standard_error_and_a_later_subscriber_has_all";
    for (variables, lines) in [
        (&[][..], 1),
        (&[("SINEW_LOG", "debug")], 2),
        (&[("RUST_LOG", "error")], 0),
        (&[("RUST_LOG", "trace"), ("SINEW_LOG", "off")], 0),
        (&[("RUST_LOG", "something_else=error")], 1),
    ] {
        let text = said(test, variables);
        assert_eq!(count(&text, "before"), usize::from(lines > 0), "{text}");
        assert_eq!(text.lines().count(), lines, "{text}");
        assert!(!text.contains('\x1b'), "no colours where it is no terminal: {text}");
    }
}
