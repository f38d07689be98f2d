//! Finds the structure of a type by reading it.
//!
//! A deserializer without bytes notes which value the type asks for next, and gives it one. The type is read again and
//! again, with other variants of its enums, until no part is unknown. The values that it was given are then written as
//! MessagePack, and read once for each field without that field. This shows which fields a receiver requires.
//!
//! The crate serde-reflection does the same in part. It does not follow an enum in a list, an option or a map to its
//! end, unless the user names that enum, and it does not try absent fields.

mod access;
mod de;
mod graph;
mod sample;
mod written;

use std::{
    collections::BTreeSet,
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
};

use serde::{Serialize, de::DeserializeOwned};

use self::{
    de::Reading,
    graph::{Content, Def, Graph, Owner},
    sample::{Place, Sample},
};
use crate::shape::Schema;

/// Maximum number of times that a type is read: once for each variant, and some for aliases.
const READS_MAX: usize = 1_024;
/// Maximum number of values that are given to one type.
const STEPS_MAX: usize = 100_000;
/// Maximum number of bytes of all samples that are decoded to try absent fields.
const TRIED_BYTES_MAX: usize = 16 << 20;
/// The number in each field, and the text: types with a check may refuse the first ones.
const FILLERS: [Filler; 2] = [Filler { number: 0, text: "" }, Filler { number: 1, text: "a" }];

/// The values that a type is given.
#[derive(Clone, Copy, Debug)]
struct Filler {
    number: u8,
    text: &'static str,
}

/// The reason why the structure of a type could not be found.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{words}")]
pub struct TraceError {
    words: String,
}

/// The two directions of a type's own bytes, as messages have them.
pub struct Wire<'w, T> {
    /// Decodes a value, and returns whether it could.
    pub accepts: &'w dyn Fn(&[u8]) -> bool,
    /// Encodes a value.
    pub writes: &'w dyn Fn(&T) -> Option<Vec<u8>>,
}

impl<T> fmt::Debug for Wire<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Wire").finish_non_exhaustive()
    }
}

impl Schema {
    /// Finds the structure of `T`, as rmp-serde writes it with field names.
    ///
    /// # Errors
    /// [`TraceError`] if `T` has no fixed structure (`flatten`, `untagged`, `tag`), has a hand-written `Deserialize`
    /// that refuses each sample, contains two types of one name, is too large, or panics.
    ///
    /// # Examples
    ///
    /// ```
    /// use serde::{Deserialize, Serialize};
    /// use sinew_schema::Schema;
    ///
    /// #[derive(Serialize, Deserialize)]
    /// struct Gains {
    ///     kp: f32,
    ///     kd: Option<f32>,
    /// }
    ///
    /// let schema = Schema::of::<Gains>().expect("it has a fixed structure");
    /// assert_eq!(schema.to_string(), "{\n    kp: f32,\n    kd: optional f32, may be absent,\n}\n");
    /// ```
    pub fn of<T: Serialize + DeserializeOwned>() -> Result<Self, TraceError> {
        let accepts = |bytes: &[u8]| rmp_serde::from_slice::<T>(bytes).is_ok();
        let writes = |value: &T| rmp_serde::to_vec_named(value).ok();
        Self::traced(&Wire { accepts: &accepts, writes: &writes })
    }

    /// Same as [`of`](Self::of), with the decoder and encoder of messages.
    ///
    /// # Errors
    /// As of [`of`](Self::of).
    pub fn traced<T: DeserializeOwned>(wire: &Wire<'_, T>) -> Result<Self, TraceError> {
        let attempt = |filler| {
            catch_unwind(AssertUnwindSafe(|| trace(wire, filler)))
                .unwrap_or_else(|_| Err(ReadError::words("its code panics with a sample".to_owned())))
        };
        let [first, second] = FILLERS;
        // The first error is the one that a reader understands: the second value is a guess.
        attempt(first)
            .or_else(|trouble| attempt(second).map_err(|_| trouble))
            .map_err(|trouble| TraceError { words: trouble.to_string() })
    }
}

fn trace<T: DeserializeOwned>(wire: &Wire<'_, T>, filler: Filler) -> Result<Schema, ReadError> {
    let mut tracer = Tracer::new(filler, Aliases::default());
    for _ in 0..READS_MAX {
        let known = tracer.graph.known();
        tracer.begin();
        let value = match T::deserialize(Reading::of_root(&mut tracer)) {
            Ok(value) => value,
            Err(ReadError::Twice { owner: Some(owner), name, given }) => {
                let mut aliases = tracer.aliases;
                aliases.found(owner, name, given);
                tracer = Tracer::new(filler, aliases);
                continue;
            }
            Err(trouble) => return Err(trouble),
        };
        let Some(sample) = tracer.samples.pop() else {
            return Err(ReadError::words("it reads no value".to_owned()));
        };
        tracer.try_absent_fields(&sample, wire)?;
        let written =
            (wire.writes)(&value).ok_or_else(|| ReadError::words("it cannot be written".to_owned()))?;
        written::check(&mut tracer.graph, &written)?;
        if !tracer.graph.has_unknown(0) {
            return tracer.finish();
        }
        if tracer.graph.known() == known {
            break;
        }
    }
    Err(ReadError::words(tracer.graph.unknown_type()))
}

/// Names that serde lists as fields and that are other names of one: `#[serde(alias)]`.
#[derive(Debug, Default)]
struct Aliases {
    names: BTreeSet<(Owner, &'static str)>,
    /// Fields that are given before all others: one name given after them is an alias.
    firsts: BTreeSet<(Owner, &'static str)>,
}

impl Aliases {
    /// Notes that `given` was one name too many of the field `name`.
    fn found(&mut self, owner: Owner, name: &'static str, given: &'static str) {
        if name == given {
            self.firsts.insert((owner, name));
        } else {
            self.firsts.remove(&(owner, name));
            self.names.insert((owner, given));
        }
    }

    /// Returns the names of a struct's fields in the order in which they are given.
    fn own_fields(&self, owner: Owner, fields: &'static [&'static str]) -> Vec<&'static str> {
        let is_own = |name: &&'static str| !self.names.contains(&(owner, *name));
        let mut own: Vec<_> = fields.iter().copied().filter(is_own).collect();
        own.sort_by_key(|name| !self.firsts.contains(&(owner, *name)));
        own
    }
}

/// All that is known of a type while it is read.
#[derive(Debug)]
struct Tracer {
    graph: Graph,
    filler: Filler,
    aliases: Aliases,
    /// The values that were given and are not yet part of another one.
    samples: Vec<Sample>,
    /// Nodes below an option, a list or a map that are being read.
    open_nodes: BTreeSet<graph::At>,
    /// Variants that are being read, the outermost first.
    open_cases: Vec<(&'static str, usize)>,
    steps: usize,
    tried_bytes: usize,
}

impl Tracer {
    fn new(filler: Filler, aliases: Aliases) -> Self {
        Self {
            graph: Graph::new(),
            filler,
            aliases,
            samples: Vec::new(),
            open_nodes: BTreeSet::new(),
            open_cases: Vec::new(),
            steps: 0,
            tried_bytes: 0,
        }
    }

    /// Prepares the next read of the whole type.
    fn begin(&mut self) {
        self.samples.clear();
        self.open_nodes.clear();
        self.open_cases.clear();
    }

    /// Counts one value that the type reads.
    fn step(&mut self) -> Result<(), ReadError> {
        self.steps += 1;
        if self.steps > STEPS_MAX {
            return Err(ReadError::words("it reads too many values".to_owned()));
        }
        Ok(())
    }

    /// Decodes the sample as it is, and without each field that was not tried before.
    fn try_absent_fields<T>(&mut self, sample: &Sample, wire: &Wire<'_, T>) -> Result<(), ReadError> {
        if !(wire.accepts)(&sample.encode(None)) {
            return Err(ReadError::words("it reads another form of its value from MessagePack".to_owned()));
        }
        let mut fields: Vec<Place> = Vec::new();
        sample.collect_fields(&mut fields);
        for place in fields {
            if self.graph.optional.contains_key(&place) {
                continue;
            }
            let bytes = sample.encode(Some(place));
            self.tried_bytes += bytes.len();
            if self.tried_bytes > TRIED_BYTES_MAX {
                return Err(ReadError::words("it has too many fields".to_owned()));
            }
            let accepts = (wire.accepts)(&bytes);
            self.graph.optional.insert(place, accepts);
        }
        Ok(())
    }

    /// Chooses the variant that is read next.
    fn choose(&self, name: &'static str) -> usize {
        let Some(Def::Enum(cases)) = self.graph.defs.get(name) else { return 0 };
        let is_open = |index: usize| self.open_cases.contains(&(name, index));
        if !self.open_cases.iter().any(|(open, _)| *open == name) {
            let unread = cases.iter().position(|case| case.read.is_none());
            let has_unknown = |content: &Content| self.graph.content_has_unknown(content);
            let unknown = || cases.iter().position(|case| case.content.as_ref().is_some_and(has_unknown));
            return unread.or_else(unknown).unwrap_or(0);
        }
        // Inside itself: the shortest one that ended, so that the value ends.
        let ended = cases.iter().enumerate().filter_map(|(index, case)| Some((case.read?.1, index)));
        let shortest = ended.min().map(|(_, index)| index);
        shortest.or_else(|| (0..cases.len()).find(|index| !is_open(*index))).unwrap_or(0)
    }

    fn finish(self) -> Result<Schema, ReadError> {
        let schema = self.graph.schema();
        match Schema::parse(&schema.encode()) {
            Ok(_) => Ok(schema),
            Err(error) => Err(ReadError::words(error.to_string())),
        }
    }
}

/// The reason why a read of the type ended.
#[derive(Debug)]
enum ReadError {
    Words(String),
    /// A field was given twice: the name `given` is another one of the field `name`.
    Twice {
        owner: Option<Owner>,
        name: &'static str,
        given: &'static str,
    },
}

impl ReadError {
    const fn words(words: String) -> Self {
        Self::Words(words)
    }
}

impl fmt::Display for ReadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Words(words) => f.write_str(words),
            Self::Twice { name, .. } => write!(f, "its field `{name}` is read twice"),
        }
    }
}

impl std::error::Error for ReadError {}

impl serde::de::Error for ReadError {
    fn custom<T: fmt::Display>(words: T) -> Self {
        let words = words.to_string();
        Self::Words(format!("it refuses the sample that it was given: {words}"))
    }

    fn duplicate_field(name: &'static str) -> Self {
        Self::Twice { owner: None, name, given: name }
    }
}
