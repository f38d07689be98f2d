//! What a person reads of a panic where nobody subscribes to the log: the program that panics is this one, started once more.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::process::Command;

use actix::{Actor, Handler};
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

/// What this program says on its standard error when its actor panics, in this test.
fn said(test: &str, backtrace: &str) -> String {
    let mut inner = Command::new(std::env::current_exe().unwrap());
    inner.args([test, "--exact", "--nocapture"]).env(INNER, "1").env("RUST_BACKTRACE", backtrace);
    let output = inner.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stderr).unwrap()
}

fn count(text: &str, what: &str) -> usize {
    text.matches(what).count()
}

#[test]
fn a_panic_that_nobody_subscribes_to_is_said_once_with_the_actor_its_thread_the_place_and_one_backtrace() {
    if std::env::var_os(INNER).is_some() {
        return panic_once();
    }
    let test = "a_panic_that_nobody_subscribes_to_is_said_once_with_the_actor_its_thread_the_place_and_one_backtrace";
    for (backtrace, wanted) in [("1", 1), ("0", 0)] {
        let text = said(test, backtrace);
        assert_eq!(count(&text, "the actor 'fragile' on thread "), 1, "{text}");
        assert_eq!(count(&text, "panicked at runtime/tests/backtraces.rs:"), 1, "{text}");
        assert_eq!(count(&text, "panicked at"), 1, "no other place: {text}");
        assert_eq!(count(&text, "this is to be read"), 1, "{text}");
        assert_eq!(count(&text, "   0: "), wanted, "{text}");
        assert_eq!(text.contains("Fragile as "), wanted == 1, "the backtrace leads to it: {text}");
    }
}

#[test]
fn a_hook_of_the_programs_own_that_captures_nothing_is_not_taken_for_the_standard_one() {
    if std::env::var_os(INNER).is_some() {
        std::panic::set_hook(Box::new(|info| {
            eprintln!("MINE: {}", info.payload_as_str().unwrap_or_default());
        }));
        return panic_once();
    }
    let text =
        said("a_hook_of_the_programs_own_that_captures_nothing_is_not_taken_for_the_standard_one", "0");
    assert_eq!(count(&text, "MINE: the actor 'fragile' on thread "), 1, "{text}");
    assert_eq!(count(&text, "this is to be read"), 1, "{text}");
}
