//! Reads the values of a file by their keys and types, and collects the faults.

use std::{collections::BTreeMap, str::FromStr, time::Duration};

use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{KEYS, SECTIONS, line_of, shown};
use crate::{
    config::{
        AppSettings, ConfigError, ConfigFault, NodeConfig,
        check::{Range, fault},
        faults::quoted,
    },
    nearest::nearest,
};

/// The values of a file by their full keys, and the faults so far.
pub(super) struct Reader<'t> {
    text: &'t str,
    pub(super) values: BTreeMap<&'static str, &'t Spanned<DeValue<'t>>>,
    pub(super) app_settings: Option<AppSettings>,
    /// The tables `[[command]]`.
    pub(super) commands: Option<&'t Spanned<DeValue<'t>>>,
    faults: Vec<ConfigFault>,
}

/// Sorting the file's keys.
impl<'t> Reader<'t> {
    pub(super) fn new(text: &'t str, table: &'t DeTable<'t>) -> Self {
        let mut reader = Self::empty(text);
        for (name, value) in table {
            let section = SECTIONS.into_iter().find(|section| *section == name.get_ref());
            match (section, value.get_ref()) {
                (Some("app"), DeValue::Table(table)) => {
                    reader.app_settings = Some(AppSettings::read(text, table));
                }
                (Some("command"), _) => reader.commands = Some(value),
                (Some(section), DeValue::Table(table)) => reader.add_keys(section, table, &KEYS),
                (Some(section), _) => {
                    let legal = format!("a section [{section}]");
                    let remedy = format!("write [{section}] on a line of its own and its keys below");
                    reader.reject(section, value, legal, remedy);
                }
                (None, DeValue::Table(_)) => reader.unknown(name, name.get_ref(), &SECTIONS),
                (None, _) => reader.unknown(name, name.get_ref(), &KEYS),
            }
        }
        reader
    }

    const fn empty(text: &'t str) -> Self {
        Self { text, values: BTreeMap::new(), app_settings: None, commands: None, faults: Vec::new() }
    }

    /// Returns a reader without values, for another table of the same file.
    pub(super) const fn beside(&self) -> Self {
        Self::empty(self.text)
    }

    /// Adds the faults of another reader. Returns whether it has none.
    pub(super) fn take_faults(&mut self, other: Self) -> bool {
        let is_faultless = other.faults.is_empty();
        self.faults.extend(other.faults);
        is_faultless
    }

    /// Adds the values of a table by their full keys, which are among `known`.
    pub(super) fn add_keys(&mut self, section: &'static str, table: &'t DeTable<'t>, known: &[&'static str]) {
        for (name, value) in table {
            let full = format!("{section}.{}", name.get_ref());
            match known.iter().copied().find(|key| *key == full) {
                Some(key) => {
                    self.values.insert(key, value);
                }
                None => self.unknown(name, &full, known),
            }
        }
    }

    fn unknown<S>(&mut self, place: &Spanned<S>, name: &str, known: &[&'static str]) {
        let (kind, remedy) = match (known == SECTIONS, nearest_key(name, known)) {
            (true, Some(nearest)) => {
                ("section", format!("write [{nearest}], the nearest section, or remove it"))
            }
            (false, Some(nearest)) => ("key", format!("write {nearest}, the nearest key, or remove it")),
            (true, None) => ("section", "remove it".to_owned()),
            (false, None) => ("key", "remove it".to_owned()),
        };
        let line = Some(line_of(self.text, &place.span()));
        let key = quoted(name).trim_matches('"').to_owned();
        let found = format!("a {kind} that does not exist");
        let legal = format!("a {kind} of docs/book/src/reference/configuration.md");
        self.faults.push(ConfigFault { line, ..fault(&key, found, legal, remedy) });
    }

    pub(super) fn reject<S>(
        &mut self,
        key: &str,
        value: &Spanned<S>,
        legal: impl Into<String>,
        remedy: impl Into<String>,
    ) {
        let found = shown(self.text, value.span());
        let line = Some(line_of(self.text, &value.span()));
        self.faults.push(ConfigFault { line, ..fault(key, found, legal, remedy) });
    }

    fn reject_number(&mut self, range: &Range, value: &Spanned<DeValue<'_>>) {
        let found = shown(self.text, value.span());
        let line = Some(line_of(self.text, &value.span()));
        self.faults.push(ConfigFault { line, ..range.fault(found) });
    }

    /// Adds the faults of the check, with their places in the file.
    pub(super) fn finish(mut self, config: &NodeConfig) -> Result<(), ConfigError> {
        let checked = config.validate().err().map(ConfigError::into_vec).unwrap_or_default();
        for mut found in checked {
            // A setting that could not be read has its default, or none, and already has a fault.
            if self.faults.iter().all(|fault| fault.key != found.key) {
                let value = self.values.get(found.key.as_str());
                found.line = value.map(|value| line_of(self.text, &value.span()));
                self.faults.push(found);
            }
        }
        self.faults.sort_by_key(|fault| fault.line);
        ConfigError::check(self.faults)
    }
}

/// Reading values by their types.
impl<'t> Reader<'t> {
    fn integer(&mut self, range: &Range) -> Option<u64> {
        let value = *self.values.get(range.key)?;
        let number = value.get_ref().as_integer();
        let read = number.and_then(|number| u64::from_str_radix(number.as_str(), number.radix()).ok());
        if read.is_none() {
            self.reject_number(range, value);
        }
        read
    }

    /// Reads a number into a type that may be too small for it.
    pub(super) fn number<T: TryFrom<u64>>(&mut self, range: &Range, target: &mut T) {
        let Some(integer) = self.integer(range) else { return };
        match T::try_from(integer) {
            Ok(number) => *target = number,
            Err(_) => self.reject_number(range, self.values[range.key]),
        }
    }

    /// Reads a number, or `false` for none.
    pub(super) fn number_or_off(&mut self, range: &Range, target: &mut Option<u64>) {
        if self.is_off(range.key) {
            *target = None;
        } else if let Some(integer) = self.integer(range) {
            *target = Some(integer);
        }
    }

    pub(super) fn time(&mut self, range: &Range, target: &mut Duration) {
        if let Some(millis) = self.integer(range) {
            *target = Duration::from_millis(millis);
        }
    }

    /// Reads a text that is a `T`; the example shows the format.
    pub(super) fn text<T: FromStr>(&mut self, key: &str, example: &str, target: &mut T) {
        let Some(value) = self.values.get(key).copied() else { return };
        match value.get_ref().as_str().map(str::parse) {
            Some(Ok(read)) => *target = read,
            Some(Err(_)) | None => {
                self.reject(
                    key,
                    value,
                    format!("a text like {example}"),
                    format!("set {key} as in {example}"),
                );
            }
        }
    }

    pub(super) fn truth(&mut self, key: &str, target: &mut bool) {
        let Some(value) = self.values.get(key).copied() else { return };
        match value.get_ref().as_bool() {
            Some(read) => *target = read,
            None => self.reject(key, value, "true or false", format!("set {key} to one of them")),
        }
    }

    /// Returns whether the value of `key` is `false`: switched off.
    pub(super) fn is_off(&self, key: &str) -> bool {
        self.values.get(key).is_some_and(|value| value.get_ref().as_bool() == Some(false))
    }

    /// Reads a text that is a `T`, or `false` for none.
    pub(super) fn text_or_off<T: FromStr>(&mut self, key: &str, example: &str, target: &mut Option<T>) {
        if self.is_off(key) {
            *target = None;
        } else {
            let mut read = Found(None);
            self.text(key, example, &mut read);
            if let Found(Some(found)) = read {
                *target = Some(found);
            }
        }
    }

    pub(super) fn read_list<T: FromStr>(
        &mut self,
        key: &'static str,
        legal: &'static str,
        remedy: &'static str,
        list: &mut Vec<T>,
    ) {
        let Some(value) = self.values.get(key).copied() else { return };
        let Some(texts) = value.get_ref().as_array() else {
            return self.reject(key, value, legal, remedy);
        };
        for text in texts {
            match text.get_ref().as_str().map(str::parse) {
                Some(Ok(item)) => list.push(item),
                Some(Err(_)) | None => self.reject(key, text, legal, remedy),
            }
        }
    }
}

/// An optional value that is read like the value itself.
pub(super) struct Found<T>(pub(super) Option<T>);

impl<T: FromStr> FromStr for Found<T> {
    type Err = T::Err;

    fn from_str(text: &str) -> Result<Self, T::Err> {
        text.parse().map(|found| Self(Some(found)))
    }
}

/// Returns the known key that is most similar to `name`. A name without a section is compared with keys without theirs.
fn nearest_key(name: &str, known: &[&'static str]) -> Option<&'static str> {
    let compared = |key: &&'static str| match key.split_once('.') {
        Some((_, leaf)) if !name.contains('.') => leaf,
        Some(_) | None => *key,
    };
    let known = known.iter().map(|key| (compared(key), *key));
    nearest(name, known, |(compared, _)| compared).first().map(|(_, key)| *key)
}
