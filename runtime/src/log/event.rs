//! A log event: recorded on its own thread, and handed to its reader on another one.

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
    observer,
    stderr::{self, Line},
    writer::enqueue,
};

/// Maximum number of fields of one event; further ones are left out.
const FIELDS_MAX: usize = 16;
/// Maximum length of one field's text in bytes; the rest is left out.
const TEXT_BYTES_MAX: usize = 4_096;

/// Returns whether events of this level have a reader.
#[must_use]
pub fn is_on(level: Level) -> bool {
    begin_default();
    level <= LevelFilter::current()
}

/// Registers the default log as a reader of events. It is never a thread's default subscriber.
fn begin_default() {
    static BEGUN: Once = Once::new();
    // The calls of `tracing` to a new subscriber cause no event. While there is a single one, `tracing` asks the
    // default of the calling thread in its place, and so would switch off all places of the code that log.
    BEGUN.call_once(|| _ = [Reader::Default, Reader::Subscriber].map(recorder));
}

/// Passes the event of `log_event` to the subscriber of this thread, or to the default log, on the log thread.
/// Never blocks.
pub fn apart(log_event: impl FnOnce()) {
    let reader = get_default(Dispatch::clone);
    let is_default = reader.is::<NoSubscriber>();
    with_default(recorder(if is_default { Reader::Default } else { Reader::Subscriber }), log_event);
    // A thread at its end may have destroyed this variable.
    let Some(recorded) = RECORDED.try_with(RefCell::take).ok().flatten() else { return };
    if is_default {
        enqueue(Box::new(move || {
            recorded.observe();
            recorded.write();
        }));
    } else {
        enqueue(Box::new(move || {
            recorded.observe();
            recorded.dispatch_to(&reader);
        }));
    }
}

/// Passes the event of `log_event` to this thread's subscriber immediately. Without a subscriber it goes to the
/// default log, as with [`apart`]. For programs that have no node, and may have been forked.
pub fn here(log_event: impl FnOnce()) {
    if get_default(|reader| reader.is::<NoSubscriber>()) {
        apart(log_event);
    } else {
        log_event();
    }
}

/// Passes on or writes the event of `log_event` immediately. On the log thread only.
pub(super) fn immediately(log_event: impl FnOnce()) {
    if stderr::is_replaced() {
        return log_event();
    }
    with_default(recorder(Reader::Default), log_event);
    if let Some(recorded) = RECORDED.take() {
        recorded.write();
    }
}

thread_local! {
    /// The last event recorded on this thread.
    static RECORDED: RefCell<Option<RecordedEvent>> = const { RefCell::new(None) };
}

/// The reader for which an event is recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reader {
    /// The program's own subscriber.
    Subscriber,
    /// The default log.
    Default,
}

/// Returns the subscriber that records events for this reader.
fn recorder(reader: Reader) -> &'static Dispatch {
    static RECORDERS: [OnceLock<Dispatch>; 2] = [const { OnceLock::new() }; 2];
    RECORDERS[usize::from(reader == Reader::Default)].get_or_init(|| Dispatch::new(Recorder(reader)))
}

struct Recorder(Reader);

impl Subscriber for Recorder {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.0 == Reader::Subscriber || stderr::wants(metadata)
    }

    // For a subscriber's events it requests nothing itself: the subscriber decides which events there are.
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
        let mut recorded =
            RecordedEvent { metadata: event.metadata(), fields: Vec::with_capacity(FIELDS_MAX), time };
        event.record(&mut recorded);
        let _ = RECORDED.try_with(|last| last.replace(Some(recorded)));
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

    fn enter(&self, _: &span::Id) {}

    fn exit(&self, _: &span::Id) {}
}

/// A recorded event with all its fields.
struct RecordedEvent {
    metadata: &'static Metadata<'static>,
    fields: Vec<(Field, FieldValue)>,
    /// When the event occurred, if that must be written.
    time: Option<SystemTime>,
}

/// Returns the time for a line of the log.
#[expect(clippy::disallowed_methods, reason = "people compare the time of a line with a clock on the wall")]
pub(crate) fn now() -> SystemTime {
    SystemTime::now()
}

/// The value of a field.
enum FieldValue {
    Bool(bool),
    Signed(i64),
    Unsigned(u64),
    Real(f64),
    Text(String),
    /// A text formatted by the value itself, to be shown unchanged.
    Formatted(String),
}

impl RecordedEvent {
    /// Passes the event to `reader`, if it is enabled there.
    fn dispatch_to(&self, reader: &Dispatch) {
        // Called on this thread, which has no subscriber of its own: it retires the default log once that is replaced.
        let _ = stderr::is_replaced();
        let words: Vec<_> = self.fields.iter().map(|(_, value)| value.formatted()).collect();
        let values: Vec<&dyn Value> =
            self.fields.iter().zip(&words).map(|((_, value), words)| value.as_value(words)).collect();
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

    /// Writes the event as a line of the default log, or passes it to the program's subscriber, if there is one now.
    fn write(self) {
        if stderr::is_replaced() {
            return self.dispatch_to(&get_default(Dispatch::clone));
        }
        let time = self.time.unwrap_or_else(now);
        let mut line = Line::new(time, *self.metadata.level(), self.metadata.target());
        let (message, fields): (Vec<_>, Vec<_>) =
            self.fields.iter().partition(|(field, _)| field.name() == "message");
        for (_, value) in message {
            line.message(&value.shown());
        }
        for (field, value) in fields {
            line.field(field.name(), &value.shown());
        }
        line.write();
    }

    /// Shows the event to the observers of the log.
    fn observe(&self) {
        observer::show(*self.metadata.level(), self.metadata.target(), || {
            let (message, fields): (Vec<_>, Vec<_>) =
                self.fields.iter().partition(|(field, _)| field.name() == "message");
            let message = message.iter().map(|(_, value)| value.shown());
            let fields = fields.iter().map(|(field, value)| format!("{}={}", field.name(), value.shown()));
            message.chain(fields).collect::<Vec<_>>().join(" ")
        });
    }

    fn push_field(&mut self, field: &Field, value: FieldValue) {
        if self.fields.len() < FIELDS_MAX {
            self.fields.push((field.clone(), value));
        }
    }
}

impl FieldValue {
    /// Returns the text of the value in a line.
    fn shown(&self) -> String {
        match self {
            Self::Bool(value) => value.to_string(),
            Self::Signed(value) => value.to_string(),
            Self::Unsigned(value) => value.to_string(),
            Self::Real(value) => value.to_string(),
            Self::Text(text) => format!("{text:?}"),
            Self::Formatted(words) => words.clone(),
        }
    }

    fn formatted(&self) -> tracing::field::DisplayValue<&str> {
        match self {
            Self::Formatted(words) => display(words.as_str()),
            Self::Bool(_) | Self::Signed(_) | Self::Unsigned(_) | Self::Real(_) | Self::Text(_) => {
                display("")
            }
        }
    }

    fn as_value<'a>(&'a self, words: &'a dyn Value) -> &'a dyn Value {
        match self {
            Self::Bool(value) => value,
            Self::Signed(value) => value,
            Self::Unsigned(value) => value,
            Self::Real(value) => value,
            Self::Text(text) => text,
            Self::Formatted(_) => words,
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
        // The error ends the formatting here.
        if more.len() > room { Err(fmt::Error) } else { Ok(()) }
    }
}

fn short(words: fmt::Arguments<'_>) -> String {
    let mut text = Short::default();
    // On overflow the text so far is used.
    let _ = fmt::write(&mut text, words);
    text.0
}

impl Visit for RecordedEvent {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.push_field(field, FieldValue::Real(value));
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.push_field(field, FieldValue::Signed(value));
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.push_field(field, FieldValue::Unsigned(value));
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.push_field(field, FieldValue::Bool(value));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.push_field(field, FieldValue::Text(short(format_args!("{value}"))));
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.push_field(field, FieldValue::Formatted(short(format_args!("{value:?}"))));
    }
}
