//! The default log: lines on the standard error, if the program has installed no `tracing` subscriber.
//!
//! It is not a global default of `tracing`: a program can install its subscriber at any time, and receives
//! all events from then on.
//!
//! The filter is set by `SINEW_LOG`, else by `RUST_LOG`, else by the configuration of the node, which is
//! `info` by default.

use std::{
    fmt::Write as _,
    io::{IsTerminal, Write as _, stderr},
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    time::SystemTime,
};

use arc_swap::ArcSwap;
use tracing::{
    Level, Metadata, callsite::rebuild_interest_cache, dispatcher::get_default, level_filters::LevelFilter,
    subscriber::NoSubscriber,
};

use super::filter::Filter;

/// The environment variable of Sinew's own log.
const OWN_VARIABLE: &str = "SINEW_LOG";
/// The environment variable that many Rust programs read.
const COMMON_VARIABLE: &str = "RUST_LOG";

/// Whether the program has a subscriber now: then no line is written here.
static IS_RETIRED: AtomicBool = AtomicBool::new(false);

fn filter() -> &'static ArcSwap<Filter> {
    static FILTER: OnceLock<ArcSwap<Filter>> = OnceLock::new();
    FILTER.get_or_init(|| ArcSwap::from_pointee(chosen(LevelFilter::INFO)))
}

/// Returns the filter of the environment, or `usual` without one.
fn chosen(usual: LevelFilter) -> Filter {
    let set = |variable| std::env::var(variable).ok().filter(|setting: &String| !setting.trim().is_empty());
    let setting = set(OWN_VARIABLE).or_else(|| set(COMMON_VARIABLE)).unwrap_or_default();
    Filter::read(&setting, usual)
}

/// Sets the level of the default log for an environment without a filter: the configuration of a node.
pub fn set_level(usual: LevelFilter) {
    filter().store(Arc::new(chosen(usual)));
    rebuild_interest_cache();
}

/// Returns whether events of this origin and level are written here.
pub(super) fn wants(metadata: &Metadata<'_>) -> bool {
    !IS_RETIRED.load(Ordering::Relaxed) && filter().load().wants(metadata.target(), *metadata.level())
}

/// Returns the maximum level that is written for any target.
pub(super) fn most() -> LevelFilter {
    if IS_RETIRED.load(Ordering::Relaxed) { LevelFilter::OFF } else { filter().load().most() }
}

/// Returns whether the program has a subscriber now. Called on the log thread, which has none of its own. The
/// default log ends when this first returns `true`.
pub(crate) fn is_replaced() -> bool {
    if IS_RETIRED.load(Ordering::Relaxed) {
        return true;
    }
    if get_default(|reader| reader.is::<NoSubscriber>()) {
        return false;
    }
    IS_RETIRED.store(true, Ordering::Relaxed);
    // From now on the subscriber alone decides which events there are.
    rebuild_interest_cache();
    true
}

/// Returns whether an error of the node is written here. Called on the log thread.
pub(super) fn writes_errors() -> bool {
    !is_replaced() && filter().load().wants(module_path!(), Level::ERROR)
}

/// A line under construction.
#[derive(Debug)]
pub(crate) struct Line {
    text: String,
    is_coloured: bool,
}

/// The style of a part of a line on a terminal.
#[derive(Clone, Copy)]
enum Style {
    Dim,
    Italic,
    Level(Level),
}

impl Line {
    /// Creates the line of an event at `time`: time, level, origin.
    pub(crate) fn new(time: SystemTime, level: Level, target: &str) -> Self {
        let mut line = Self { text: String::with_capacity(160), is_coloured: is_coloured() };
        let time = humantime::format_rfc3339_millis(time).to_string();
        line.push(Style::Dim, &time);
        line.text.push(' ');
        line.push(Style::Level(level), &format!("{level:>5}"));
        line.text.push(' ');
        line.push(Style::Dim, &format!("{}:", layer(target)));
        line
    }

    /// Appends the message of the event.
    pub(crate) fn message(&mut self, words: &str) {
        self.text.push(' ');
        self.plain(words);
    }

    /// Appends a field.
    pub(crate) fn field(&mut self, name: &str, value: &str) {
        self.text.push(' ');
        self.push(Style::Italic, name);
        self.text.push('=');
        self.plain(value);
    }

    /// Writes the line. Blocks while the reader of the standard error does. A closed standard error is ignored.
    pub(crate) fn write(mut self) {
        self.text.push('\n');
        write_text(&self.text);
    }

    /// Appends untrusted text, so that it cannot start a line of its own or send control characters to the terminal.
    fn plain(&mut self, words: &str) {
        for part in words.chars() {
            match part {
                '\n' => self.text.push_str("\n    "),
                part if part.is_control() => self.text.extend(part.escape_default()),
                part => self.text.push(part),
            }
        }
    }

    fn push(&mut self, style: Style, words: &str) {
        if !self.is_coloured {
            return self.text.push_str(words);
        }
        let code = match style {
            Style::Dim => "2",
            Style::Italic => "3",
            Style::Level(Level::ERROR) => "31",
            Style::Level(Level::WARN) => "33",
            Style::Level(Level::INFO) => "32",
            Style::Level(Level::DEBUG) => "34",
            Style::Level(Level::TRACE) => "35",
        };
        // Writing to a text does not fail.
        let _ = write!(self.text, "\x1b[{code}m{words}\x1b[0m");
    }
}

/// Writes to the standard error, in one piece.
pub(crate) fn write_text(text: &str) {
    // A write error has no other place to be reported.
    let _ = stderr().write_all(text.as_bytes());
}

/// The layer of the module `target`: `sinew::gncl` of `sinew::gncl::actor`.
fn layer(target: &str) -> &str {
    target.match_indices("::").nth(1).map_or(target, |(end, _)| &target[..end])
}

/// Returns whether the standard error is a terminal and `NO_COLOR` is not set (<https://no-color.org>).
fn is_coloured() -> bool {
    static IS_COLOURED: OnceLock<bool> = OnceLock::new();
    *IS_COLOURED.get_or_init(|| {
        let is_set = |variable| std::env::var_os(variable).is_some_and(|value| !value.is_empty());
        let is_dumb = std::env::var_os("TERM").is_some_and(|term| term == "dumb");
        stderr().is_terminal() && !is_set("NO_COLOR") && !is_dumb
    })
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, UNIX_EPOCH};

    use super::*;

    fn line(is_coloured: bool) -> String {
        let time = UNIX_EPOCH + Duration::from_millis(1_790_000_000_123);
        let mut line = Line::new(time, Level::WARN, "sinew::gncl::actor::leaving");
        line.is_coloured = is_coloured;
        line.message("first\nERROR \x1b[31mforged\r");
        line.field("node", "10.0.0.7");
        line.text
    }

    #[test]
    fn line_has_all_parts_and_no_foreign_control_characters() {
        let text = line(false);
        let head = "2026-09-21T14:13:20.123Z  WARN sinew::gncl:";
        assert_eq!(text, format!("{head} first\n    ERROR \\u{{1b}}[31mforged\\r node=10.0.0.7"));
    }

    #[test]
    fn field_names_are_styled_on_a_terminal() {
        assert!(line(true).contains("\x1b[3mnode\x1b[0m=10.0.0.7"));
    }

    #[test]
    fn target_is_shown_as_its_layer() {
        let shown = ["sinew", "sinew::node", "sinew_runtime::app::context::deep"].map(layer);
        assert_eq!(shown, ["sinew", "sinew::node", "sinew_runtime::app"]);
    }
}
