//! An event of the log: taken down where it happens, told to its reader elsewhere.

use std::{
    cell::RefCell,
    fmt,
    sync::{Once, OnceLock},
    time::SystemTime,
};

use tracing::{
    Dispatch, Event, Level, Metadata, Subscriber,
    dispatcher::{get_default, with_default},
    field::{Field, Value, Visit, display},
    level_filters::LevelFilter,
    span,
    subscriber::{Interest, NoSubscriber},
};

use super::{
    stderr::{self, Line},
    writer::enter,
};

/// Fields of one event at most; more are left out.
const FIELDS_MAX: usize = 16;
/// Bytes of one field's text at most; the rest is left out.
const TEXT_BYTES_MAX: usize = 4_096;

/// Whether anybody reads events of this level.
#[must_use]
pub fn is_on(level: Level) -> bool {
    begin_default();
    level <= LevelFilter::current()
}

/// Has the default log count among those that may read events. It is nobody's default subscriber.
fn begin_default() {
    static BEGUN: Once = Once::new();
    // What `tracing` asks a new subscriber leads to no event.
    BEGUN.call_once(|| _ = notebook(Reader::Default));
}

/// Has the event that `say` says told to this thread's subscriber, or written by the default log, on the log's thread. Waits for nobody.
pub fn apart(say: impl FnOnce()) {
    let reader = get_default(Dispatch::clone);
    let is_default = reader.is::<NoSubscriber>();
    with_default(notebook(if is_default { Reader::Default } else { Reader::Subscriber }), say);
    // A thread that is about to end has no notebook any more.
    let Some(noted) = NOTED.try_with(RefCell::take).ok().flatten() else { return };
    if is_default {
        enter(Box::new(move || noted.write()));
    } else {
        enter(Box::new(move || noted.tell(&reader)));
    }
}

/// Has the event that `say` says told to this thread's subscriber here and now. Where there is none, it goes to the default log as with
/// [`apart`]: for programs that have no node, and may have been forked.
pub fn here(say: impl FnOnce()) {
    if get_default(|reader| reader.is::<NoSubscriber>()) {
        apart(say);
    } else {
        say();
    }
}

/// On the log's thread: has the event that `say` says told or written now.
pub(super) fn at_once(say: impl FnOnce()) {
    if stderr::is_replaced() {
        return say();
    }
    with_default(notebook(Reader::Default), say);
    if let Some(noted) = NOTED.take() {
        noted.write();
    }
}

thread_local! {
    /// What was said last on this thread.
    static NOTED: RefCell<Option<Noted>> = const { RefCell::new(None) };
}

/// For which reader an event is taken down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reader {
    /// The program's own.
    Subscriber,
    /// The default log.
    Default,
}

/// The subscriber that takes down what is said for this reader.
fn notebook(reader: Reader) -> &'static Dispatch {
    static NOTEBOOKS: [OnceLock<Dispatch>; 2] = [const { OnceLock::new() }; 2];
    NOTEBOOKS[usize::from(reader == Reader::Default)].get_or_init(|| Dispatch::new(Notebook(reader)))
}

struct Notebook(Reader);

impl Subscriber for Notebook {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.0 == Reader::Subscriber || stderr::wants(metadata)
    }

    // For a subscriber's events it wants nothing itself: which ones there are is that one's business.
    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        match self.0 {
            Reader::Default if stderr::wants(metadata) => Interest::sometimes(),
            Reader::Default | Reader::Subscriber => Interest::never(),
        }
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(match self.0 {
            Reader::Default => stderr::most(),
            Reader::Subscriber => LevelFilter::OFF,
        })
    }

    fn event(&self, event: &Event<'_>) {
        let time = (self.0 == Reader::Default).then(now);
        let mut noted = Noted { metadata: event.metadata(), fields: Vec::with_capacity(FIELDS_MAX), time };
        event.record(&mut noted);
        let _ = NOTED.try_with(|last| last.replace(Some(noted)));
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

    fn enter(&self, _: &span::Id) {}

    fn exit(&self, _: &span::Id) {}
}

/// An event with all that it says.
struct Noted {
    metadata: &'static Metadata<'static>,
    fields: Vec<(Field, Said)>,
    /// When it happened, where that is to be written.
    time: Option<SystemTime>,
}

/// The time that a line of the log shows.
#[expect(clippy::disallowed_methods, reason = "people compare the time of a line with a clock on the wall")]
pub(crate) fn now() -> SystemTime {
    SystemTime::now()
}

/// What a field says.
enum Said {
    Bool(bool),
    Signed(i64),
    Unsigned(u64),
    Real(f64),
    Text(String),
    /// Written by what it is of, and to be read as it stands.
    Words(String),
}

impl Noted {
    /// Tells it to `reader`, if that wants it.
    fn tell(&self, reader: &Dispatch) {
        // Said on this thread, which has no subscriber of its own: it retires the default log where that has become idle.
        let _ = stderr::is_replaced();
        let words: Vec<_> = self.fields.iter().map(|(_, said)| said.words()).collect();
        let values: Vec<&dyn Value> =
            self.fields.iter().zip(&words).map(|((_, said), words)| said.value(words)).collect();
        let Some((first, _)) = self.fields.first() else { return };
        let mut pairs: [(&Field, Option<&dyn Value>); FIELDS_MAX] = [(first, None); FIELDS_MAX];
        for (pair, ((field, _), value)) in pairs.iter_mut().zip(self.fields.iter().zip(values)) {
            *pair = (field, Some(value));
        }
        if reader.enabled(self.metadata) {
            with_default(reader, || {
                Event::dispatch(self.metadata, &self.metadata.fields().value_set(&pairs));
            });
        }
    }

    /// Writes it as a line of the default log; tells the program's subscriber, if there is one by now.
    fn write(self) {
        if stderr::is_replaced() {
            return self.tell(&get_default(Dispatch::clone));
        }
        let time = self.time.unwrap_or_else(now);
        let mut line = Line::new(time, *self.metadata.level(), self.metadata.target());
        let (message, fields): (Vec<_>, Vec<_>) =
            self.fields.iter().partition(|(field, _)| field.name() == "message");
        for (_, said) in message {
            line.message(&said.shown());
        }
        for (field, said) in fields {
            line.field(field.name(), &said.shown());
        }
        line.write();
    }

    fn note(&mut self, field: &Field, said: Said) {
        if self.fields.len() < FIELDS_MAX {
            self.fields.push((field.clone(), said));
        }
    }
}

impl Said {
    /// What a line shows of it.
    fn shown(&self) -> String {
        match self {
            Self::Bool(value) => value.to_string(),
            Self::Signed(value) => value.to_string(),
            Self::Unsigned(value) => value.to_string(),
            Self::Real(value) => value.to_string(),
            Self::Text(text) => format!("{text:?}"),
            Self::Words(words) => words.clone(),
        }
    }

    fn words(&self) -> tracing::field::DisplayValue<&str> {
        match self {
            Self::Words(words) => display(words.as_str()),
            Self::Bool(_) | Self::Signed(_) | Self::Unsigned(_) | Self::Real(_) | Self::Text(_) => {
                display("")
            }
        }
    }

    fn value<'a>(&'a self, words: &'a dyn Value) -> &'a dyn Value {
        match self {
            Self::Bool(value) => value,
            Self::Signed(value) => value,
            Self::Unsigned(value) => value,
            Self::Real(value) => value,
            Self::Text(text) => text,
            Self::Words(_) => words,
        }
    }
}

/// A text of bounded length.
#[derive(Default)]
struct Short(String);

impl fmt::Write for Short {
    fn write_str(&mut self, more: &str) -> fmt::Result {
        let room = TEXT_BYTES_MAX - self.0.len();
        self.0.push_str(&more[..more.floor_char_boundary(room)]);
        // Whoever writes stops here.
        if more.len() > room { Err(fmt::Error) } else { Ok(()) }
    }
}

fn short(words: fmt::Arguments<'_>) -> String {
    let mut text = Short::default();
    // Too long: what there is of it is said.
    let _ = fmt::write(&mut text, words);
    text.0
}

impl Visit for Noted {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.note(field, Said::Real(value));
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.note(field, Said::Signed(value));
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.note(field, Said::Unsigned(value));
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.note(field, Said::Bool(value));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.note(field, Said::Text(short(format_args!("{value}"))));
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.note(field, Said::Words(short(format_args!("{value:?}"))));
    }
}
