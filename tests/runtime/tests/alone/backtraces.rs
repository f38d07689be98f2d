//! The report of a panic without a subscriber to the log.

use std::sync::{Arc, Mutex, mpsc::sync_channel};

use actix::{Actor, Handler};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    log::{self, LogObserver, observe},
    supervision::Reason,
};

use super::{alone, is_alone, reader::Reader, run_alone};
use sinew_runtime_tests::{DEADLINE, Number, Stage};

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

/// Returns the standard error of this program when it plays its part in this test, with these variables set.
fn error_output(test: &str, variables: &[(&str, &str)]) -> String {
    String::from_utf8(run_alone(&format!("backtraces::{test}"), variables).stderr).unwrap()
}

fn count(text: &str, what: &str) -> usize {
    text.matches(what).count()
}

#[test]
fn panic_is_reported_once_with_actor_place_and_frames() {
    if is_alone() {
        return panic_once();
    }
    let test = "panic_is_reported_once_with_actor_place_and_frames";
    for (variables, frames) in [
        (&[][..], 1..=10),
        (&[("RUST_BACKTRACE", "1")], 1..=10),
        (&[("RUST_BACKTRACE", "0")], 0..=0),
        // Panics are reported even if the log is off.
        (&[("SINEW_LOG", "off")], 1..=10),
    ] {
        let text = error_output(test, variables);
        assert_eq!(count(&text, "the actor 'fragile' on thread "), 1, "{text}");
        assert_eq!(count(&text, "panicked at tests/runtime/tests/alone/backtraces.rs:"), 1, "{text}");
        assert_eq!(count(&text, "panicked at"), 1, "no other place: {text}");
        assert_eq!(count(&text, "this is to be read"), 1, "{text}");
        let shown: Vec<_> = text.lines().filter(|line| line.starts_with("      at ")).collect();
        assert!(frames.contains(&shown.len()), "{text}");
        assert!(shown.iter().all(|frame| frame.contains("backtraces.rs")), "its own code alone: {text}");
        assert_eq!(count(&text, "stack backtrace:"), 0, "not the standard hook as well: {text}");
    }
    let text = error_output(test, &[("RUST_BACKTRACE", "full")]);
    assert!(count(&text, "sinew_runtime::") > 3, "all frames: {text}");
}

/// Keeps the texts of all errors.
#[derive(Default)]
struct Errors(Mutex<Vec<String>>);

impl LogObserver for Errors {
    fn wrote(&self, level: tracing::Level, _: &str, text: &str) {
        if level == tracing::Level::ERROR {
            self.0.lock().unwrap().push(text.to_owned());
        }
    }
}

#[test]
fn panic_is_shown_to_observers_once() {
    alone("backtraces::panic_is_shown_to_observers_once", || {
        let errors = Arc::new(Errors::default());
        let observer: Arc<dyn LogObserver> = errors.clone();
        assert!(observe(&observer));
        panic_once();
        let errors = errors.0.lock().unwrap();
        let panics: Vec<_> = errors.iter().filter(|text| text.contains("this is to be read")).collect();
        assert!(panics.len() == 1 && panics[0].contains("the actor 'fragile' on thread "), "{errors:?}");
    });
}

#[test]
fn hook_of_the_program_stays_in_use() {
    if is_alone() {
        std::panic::set_hook(Box::new(|info| {
            eprintln!("MINE: {}", info.payload_as_str().unwrap_or_default());
        }));
        return panic_once();
    }
    let test = "hook_of_the_program_stays_in_use";
    let text = error_output(test, &[("RUST_BACKTRACE", "0")]);
    assert_eq!(count(&text, "MINE: the actor 'fragile' on thread "), 1, "{text}");
    assert_eq!(count(&text, "this is to be read"), 1, "{text}");
}

#[test]
fn panic_outside_actors_is_left_to_the_standard_hook() {
    if is_alone() {
        panic_once();
        let _ = std::thread::spawn(|| panic!("of the program's own")).join();
        return log::flush(DEADLINE);
    }
    let test = "panic_outside_actors_is_left_to_the_standard_hook";
    let text = error_output(test, &[("RUST_BACKTRACE", "0")]);
    assert_eq!(count(&text, "of the program's own"), 1, "{text}");
    assert!(text.contains("thread '<unnamed>'"), "{text}");
}

#[test]
fn log_goes_to_standard_error_until_a_subscriber_exists() {
    if is_alone() {
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
    let test = "log_goes_to_standard_error_until_a_subscriber_exists";
    for (variables, lines) in [
        (&[][..], 1),
        (&[("SINEW_LOG", "debug")], 2),
        (&[("RUST_LOG", "error")], 0),
        (&[("RUST_LOG", "trace"), ("SINEW_LOG", "off")], 0),
        (&[("RUST_LOG", "something_else=error")], 1),
    ] {
        let text = error_output(test, variables);
        assert_eq!(count(&text, "before"), usize::from(lines > 0), "{text}");
        assert_eq!(text.lines().count(), lines, "{text}");
        assert!(!text.contains('\x1b'), "no colours where it is no terminal: {text}");
    }
}
