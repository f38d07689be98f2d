//! The default log: lines on the standard error, where the program has installed no subscriber of `tracing`.
//!
//! It is no global default of `tracing`: a program can install its subscriber at any time, and has all events from then on.
//!
//! What is written is set by `SINEW_LOG`, else by `RUST_LOG`, else by the configuration of the node, which is `info` by default.

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
/// The one that many programs in Rust read.
const COMMON_VARIABLE: &str = "RUST_LOG";

/// The program has a subscriber by now: nothing is written here any more.
static IS_RETIRED: AtomicBool = AtomicBool::new(false);

fn filter() -> &'static ArcSwap<Filter> {
    static FILTER: OnceLock<ArcSwap<Filter>> = OnceLock::new();
    FILTER.get_or_init(|| ArcSwap::from_pointee(chosen(LevelFilter::INFO)))
}

/// What the environment says, and `usual` where it says nothing.
fn chosen(usual: LevelFilter) -> Filter {
    let set = |variable| std::env::var(variable).ok().filter(|said: &String| !said.trim().is_empty());
    let said = set(OWN_VARIABLE).or_else(|| set(COMMON_VARIABLE)).unwrap_or_default();
    Filter::read(&said, usual)
}

/// Sets how much the default log writes where the environment says nothing of it: the configuration of a node.
pub fn set_level(usual: LevelFilter) {
    filter().store(Arc::new(chosen(usual)));
    rebuild_interest_cache();
}

/// Whether events of this origin and level are written here.
pub(super) fn wants(metadata: &Metadata<'_>) -> bool {
    !IS_RETIRED.load(Ordering::Relaxed) && filter().load().wants(metadata.target(), *metadata.level())
}

/// The most that is written of anything.
pub(super) fn most() -> LevelFilter {
    if IS_RETIRED.load(Ordering::Relaxed) { LevelFilter::OFF } else { filter().load().most() }
}

/// Whether the program has a subscriber by now. Asked on the log's thread, which has none of its own. The default log ends with
/// the first answer that is yes.
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

/// Whether an error of the node's is written here. Asked on the log's thread.
pub(super) fn writes_errors() -> bool {
    !is_replaced() && filter().load().wants(module_path!(), Level::ERROR)
}

/// A line as it is put together.
#[derive(Debug)]
pub(crate) struct Line {
    text: String,
    is_coloured: bool,
}

/// How a part of a line looks on a terminal.
#[derive(Clone, Copy)]
enum Look {
    Dim,
    Italic,
    Level(Level),
}

impl Line {
    /// The line of an event at `time`: time, level, origin.
    pub(crate) fn new(time: SystemTime, level: Level, target: &str) -> Self {
        let mut line = Self { text: String::with_capacity(160), is_coloured: is_coloured() };
        let time = humantime::format_rfc3339_millis(time).to_string();
        line.push(Look::Dim, &time);
        line.text.push(' ');
        line.push(Look::Level(level), &format!("{level:>5}"));
        line.text.push(' ');
        line.push(Look::Dim, &format!("{}:", layer(target)));
        line
    }

    /// Appends what the event says.
    pub(crate) fn message(&mut self, words: &str) {
        self.text.push(' ');
        self.plain(words);
    }

    /// Appends a field.
    pub(crate) fn field(&mut self, name: &str, value: &str) {
        self.text.push(' ');
        self.push(Look::Italic, name);
        self.text.push('=');
        self.plain(value);
    }

    /// Writes it. Waits for who reads the standard error. One that is closed takes nothing.
    pub(crate) fn write(mut self) {
        self.text.push('\n');
        write_text(&self.text);
    }

    /// Text of anybody's: it begins no line that looks like one of the log's, and no control character reaches the terminal.
    fn plain(&mut self, words: &str) {
        for part in words.chars() {
            match part {
                '\n' => self.text.push_str("\n    "),
                part if part.is_control() => self.text.extend(part.escape_default()),
                part => self.text.push(part),
            }
        }
    }

    fn push(&mut self, look: Look, words: &str) {
        if !self.is_coloured {
            return self.text.push_str(words);
        }
        let code = match look {
            Look::Dim => "2",
            Look::Italic => "3",
            Look::Level(Level::ERROR) => "31",
            Look::Level(Level::WARN) => "33",
            Look::Level(Level::INFO) => "32",
            Look::Level(Level::DEBUG) => "34",
            Look::Level(Level::TRACE) => "35",
        };
        // Writing to a text does not fail.
        let _ = write!(self.text, "\x1b[{code}m{words}\x1b[0m");
    }
}

/// Writes to the standard error, in one piece.
pub(crate) fn write_text(text: &str) {
    // There is no other place to say that this one takes nothing.
    let _ = stderr().write_all(text.as_bytes());
}

/// The layer of the module `target`: `sinew::gncl` of `sinew::gncl::actor`.
fn layer(target: &str) -> &str {
    target.match_indices("::").nth(1).map_or(target, |(end, _)| &target[..end])
}

/// Whether the standard error is a terminal, and nobody has asked for no colours (<https://no-color.org>).
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
    fn a_line_has_time_level_layer_message_and_fields_and_no_control_character_of_others() {
        let text = line(false);
        let head = "2026-09-21T14:13:20.123Z  WARN sinew::gncl:";
        assert_eq!(text, format!("{head} first\n    ERROR \\u{{1b}}[31mforged\\r node=10.0.0.7"));
    }

    #[test]
    fn names_of_fields_have_a_look_of_their_own_on_a_terminal() {
        assert!(line(true).contains("\x1b[3mnode\x1b[0m=10.0.0.7"));
    }

    #[test]
    fn a_target_is_shown_as_its_layer() {
        let shown = ["sinew", "sinew::node", "sinew_runtime::app::context::deep"].map(layer);
        assert_eq!(shown, ["sinew", "sinew::node", "sinew_runtime::app"]);
    }
}
