//! Names that protocol buffers accept, made from those of Rust and of payload types.

use std::collections::BTreeSet;

/// Returns a name with the letters, digits and underscores of `text`. It does not begin with a digit.
pub(super) fn identifier(text: &str) -> String {
    let kept = |character: char| if character.is_ascii_alphanumeric() { character } else { '_' };
    let name: String = text.chars().map(kept).collect();
    if name.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_') {
        name
    } else {
        format!("_{name}")
    }
}

/// Returns a name of a type: each word with a capital.
pub(super) fn camel(text: &str) -> String {
    let words = text.split(|character: char| !character.is_ascii_alphanumeric());
    let capital = |word: &str| {
        let (first, rest) = word.split_at(1);
        first.to_ascii_uppercase() + rest
    };
    let name: String = words.filter(|word| !word.is_empty()).map(capital).collect();
    if name.is_empty() { "Type".to_owned() } else { identifier(&name) }
}

/// Returns the package and the message's name of a payload type: `exo.angle` is `Angle` in `sinew.exo`.
pub(super) fn of_type(type_name: &str) -> (String, String) {
    let (above, own) = type_name.rsplit_once('.').unwrap_or(("", type_name));
    let parts = above.split('.').filter(|part| !part.is_empty());
    let package = parts.fold("sinew".to_owned(), |all, part| format!("{all}.{}", snake(part)));
    (package, camel(own))
}

fn snake(text: &str) -> String {
    identifier(&text.to_ascii_lowercase())
}

/// The names of fields, or of an enum's values. Two names that differ in case or underscores alone count as the same,
/// as in the rules of protocol buffers for JSON.
#[derive(Debug, Default)]
pub(super) struct Fields(BTreeSet<String>);

impl Fields {
    /// Returns this name, or with a number behind it, where it is taken.
    pub(super) fn unique(&mut self, name: &str) -> String {
        unique(name, |name| {
            let key: String = name.chars().filter(|character| *character != '_').collect();
            self.0.insert(key.to_ascii_lowercase())
        })
    }
}

/// The names of types. They share their scope with fields, but not with the names that fields have in JSON.
#[derive(Debug, Default)]
pub(super) struct Types(BTreeSet<String>);

impl Types {
    /// Returns this name, or with a number behind it, where it is taken.
    pub(super) fn unique(&mut self, name: &str) -> String {
        unique(name, |name| self.0.insert(name.to_owned()))
    }
}

fn unique(name: &str, mut is_free: impl FnMut(&str) -> bool) -> String {
    let mut found = name.to_owned();
    for number in 2_u32.. {
        if is_free(&found) {
            break;
        }
        found = format!("{name}_v{number}");
    }
    found
}
