//! An event of the log: taken down where it happens, told to its reader elsewhere.

use std::{cell::RefCell, fmt, sync::OnceLock};

use tracing::{
    Dispatch, Event, Level, Metadata, Subscriber,
    dispatcher::{get_default, with_default},
    field::{Field, Value, Visit, display},
    level_filters::LevelFilter,
    span,
    subscriber::{Interest, NoSubscriber},
};

use super::writer::enter;

/// Fields of one event at most; more are left out.
const FIELDS_MAX: usize = 16;
/// Bytes of one field's text at most; the rest is left out.
const TEXT_BYTES_MAX: usize = 4_096;

/// Whether anybody reads events of this level.
#[must_use]
pub fn is_on(level: Level) -> bool {
    level <= LevelFilter::current()
}

/// Has the event that `say` says told to this thread's subscriber, on the log's thread. Waits for nobody.
pub fn apart(say: impl FnOnce()) {
    let reader = get_default(Dispatch::clone);
    if reader.is::<NoSubscriber>() {
        return;
    }
    with_default(notebook(), say);
    // A thread that is about to end has no notebook any more.
    if let Some(noted) = NOTED.try_with(RefCell::take).ok().flatten() {
        enter(Box::new(move || noted.tell(&reader)));
    }
}

thread_local! {
    /// What was said last on this thread.
    static NOTED: RefCell<Option<Noted>> = const { RefCell::new(None) };
}

/// The subscriber that takes down what is said.
fn notebook() -> &'static Dispatch {
    static NOTEBOOK: OnceLock<Dispatch> = OnceLock::new();
    NOTEBOOK.get_or_init(|| Dispatch::new(Notebook))
}

struct Notebook;

impl Subscriber for Notebook {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    // It wants nothing for itself: which events there are is the other subscribers' business.
    fn register_callsite(&self, _: &'static Metadata<'static>) -> Interest {
        Interest::never()
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(LevelFilter::OFF)
    }

    fn event(&self, event: &Event<'_>) {
        let mut noted = Noted { metadata: event.metadata(), fields: Vec::with_capacity(FIELDS_MAX) };
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

    fn note(&mut self, field: &Field, said: Said) {
        if self.fields.len() < FIELDS_MAX {
            self.fields.push((field.clone(), said));
        }
    }
}

impl Said {
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
