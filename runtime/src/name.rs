//! Names: the one grammar of applications, supervisors, groups, barriers, payload types, nodes and projects.
//!
//! A name is 1 to 63 bytes of UTF-8. It has
//!
//! - no control characters, line separators, and no characters without a width or with a direction of their
//!   own (`U+200B`, `U+202E`);
//! - no white space at its beginning or end;
//! - no `*` and no `|`: these belong to the language of requirements;
//! - no form that the language of requirements reads as more than a name: `2 of drives`, `drive at homed`,
//!   `camera ?2s`;
//! - no form of an address: `10.0.0.2`, `10.0.0.2/80000001`;
//! - no form of a kind's number: `0x80001f2e`.
//!
//! The name of a node or a project is also the name of a directory and of files, and appears on command lines
//! ([`check_node_name`]). It has
//!
//! - no `/` and no `=`;
//! - no `-` and no `.` at its beginning;
//! - no `.toml` at its end.

use crate::{
    app::Requirement,
    tid::{NodeAddress, Tid},
};

/// Maximum length of a name in bytes.
pub const NAME_BYTES_MAX: usize = 63;

/// The reason why a text is not a valid name. This is an error of the caller.
///
/// # Examples
///
/// ```
/// use sinew::name::{NameError, check_name};
///
/// assert_eq!(check_name("leg.*"), Err(NameError::Reserved('*')));
/// assert_eq!(check_name("10.0.0.2"), Err(NameError::Address));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// The text is empty.
    #[error("it is empty; a name has 1 to {NAME_BYTES_MAX} bytes")]
    Empty,
    /// The text has more than [`NAME_BYTES_MAX`] bytes.
    #[error("it has {0} bytes, and a name has at most {NAME_BYTES_MAX}")]
    TooLong(usize),
    /// The text has a character that a reader would not see.
    #[error("it contains the invisible character U+{:04X}; remove it", u32::from(*.0))]
    Invisible(char),
    /// The text begins or ends with white space.
    #[error("it begins or ends with white space; remove that")]
    WhiteSpace,
    /// The text has a character of the language of requirements.
    #[error(
        "'{0}' belongs to the language of requirements (`a | b`, `drive.*`); use letters, digits, '.', '_' or '-' instead"
    )]
    Reserved(char),
    /// The text has another meaning as a requirement.
    #[error(
        "as a requirement it asks for something else (`2 of drives`, `drive at homed`, `camera ?2s`); choose another name"
    )]
    Expression,
    /// The text has the form of an address.
    #[error("it reads as the address of a node or an application; choose another name")]
    Address,
    /// The text has the form of a kind's number.
    #[error("it reads as the number of a message's kind (`0x80001f2e`); choose another name")]
    Number,
    /// The name of a node or a project has a character that cannot be used in file names or command options.
    #[error(
        "'{0}' cannot stand in the name of a node or a project, which names directories and files; use letters, digits, '.', '_' or '-' instead"
    )]
    File(char),
    /// The name of a node or a project begins like an option or a hidden file.
    #[error(
        "the name of a node or a project begins with a letter, a digit or '_', not with '{0}': it names directories and stands on command lines"
    )]
    First(char),
    /// The name of a node or a project ends like a configuration file.
    #[error("it reads as the name of a configuration file (`knee.toml`); leave out `.toml`")]
    Toml,
}

/// Checks a name against the grammar of this module.
///
/// # Errors
/// The first rule that the text breaks.
///
/// # Examples
///
/// ```
/// use sinew::name::check_name;
///
/// assert!(check_name("knee.drive").is_ok());
/// let why = check_name("2 of drives").unwrap_err();
/// assert!(why.to_string().ends_with("choose another name"));
/// ```
pub fn check_name(name: &str) -> Result<(), NameError> {
    if name.is_empty() {
        return Err(NameError::Empty);
    }
    if name.len() > NAME_BYTES_MAX {
        return Err(NameError::TooLong(name.len()));
    }
    if let Some(invisible) = name.chars().find(|character| is_invisible(*character)) {
        return Err(NameError::Invisible(invisible));
    }
    if name.trim() != name {
        return Err(NameError::WhiteSpace);
    }
    if let Some(reserved) = name.chars().find(|character| "*|".contains(*character)) {
        return Err(NameError::Reserved(reserved));
    }
    let requirement = name.parse::<Requirement>();
    if !requirement.is_ok_and(|requirement| requirement.only_name() == Some(name)) {
        return Err(NameError::Expression);
    }
    if name.parse::<NodeAddress>().is_ok() || name.parse::<Tid>().is_ok() {
        return Err(NameError::Address);
    }
    let is_hexadecimal = |digits: &str| digits.chars().all(|digit| digit.is_ascii_hexdigit());
    if name.strip_prefix("0x").is_some_and(is_hexadecimal) {
        return Err(NameError::Number);
    }
    Ok(())
}

/// Checks a pattern of names, where `*` matches any text. A pattern that no legal name can match is rejected.
///
/// # Errors
/// The first rule that each text of this pattern breaks.
///
/// # Examples
///
/// ```
/// use sinew::name::{NameError, check_name_pattern};
///
/// assert!(check_name_pattern("leg.*").is_ok());
/// assert_eq!(check_name_pattern("leg.* | arm.*"), Err(NameError::Reserved('|')));
/// ```
pub fn check_name_pattern(pattern: &str) -> Result<(), NameError> {
    // Any character that is legal everywhere.
    check_name(&pattern.replace('*', "x"))
}

/// Checks the name of a node or a project: [`check_name`], and the rules for directories, files and command lines.
///
/// # Errors
/// The first rule that the text breaks.
///
/// # Examples
///
/// ```
/// use sinew::name::{NameError, check_name, check_node_name};
///
/// assert!(check_name("leg/sensor").is_ok());
/// assert_eq!(check_node_name("leg/sensor"), Err(NameError::File('/')));
/// ```
pub fn check_node_name(name: &str) -> Result<(), NameError> {
    check_name(name)?;
    if let Some(unfit) = name.chars().find(|character| "/=".contains(*character)) {
        return Err(NameError::File(unfit));
    }
    if let Some(first) = name.chars().next().filter(|first| "-.".contains(*first)) {
        return Err(NameError::First(first));
    }
    if name.ends_with(".toml") {
        return Err(NameError::Toml);
    }
    Ok(())
}

/// Returns whether a character is invisible and changes how the text around it is shown: controls, line and
/// paragraph separators, characters that set the direction of text, characters without width, and tags.
#[must_use]
pub fn is_invisible(character: char) -> bool {
    character.is_control()
        || matches!(
            character,
            '\u{ad}' | '\u{34f}' | '\u{61c}' | '\u{115f}' | '\u{1160}' | '\u{17b4}' | '\u{17b5}' | '\u{180b}'..='\u{180f}'
                | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{3164}' | '\u{fe00}'..='\u{fe0f}'
                | '\u{feff}' | '\u{ffa0}' | '\u{fff0}'..='\u{fffb}' | '\u{1bca0}'..='\u{1bca3}' | '\u{1d173}'..='\u{1d17a}'
                | '\u{e0000}'..='\u{e0fff}'
        )
}

/// Returns a text from outside for display: each invisible character as its escape, `\u{202e}`.
#[must_use]
pub fn shown(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        if is_invisible(character) {
            shown.extend(character.escape_unicode());
        } else {
            shown.push(character);
        }
    }
    shown
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn names_of_every_kind_in_use_are_legal() {
        for name in [
            "knee",
            "knee.drive",
            "sync manager",
            "Knie-Antrieb_2",
            "膝.駆動",
            "a/b",
            "a@b",
            "2 of",
            "of",
            "cam?",
        ] {
            assert_eq!(check_name(name), Ok(()), "{name:?}");
        }
    }

    #[test]
    fn name_that_requirements_cannot_express_is_rejected() {
        for (name, why) in [
            ("", NameError::Empty),
            ("a|b", NameError::Reserved('|')),
            ("leg.*", NameError::Reserved('*')),
            ("2 of drives", NameError::Expression),
            ("drive at homed", NameError::Expression),
            ("camera ?2s", NameError::Expression),
            ("camera ?soon", NameError::Expression),
            (" knee", NameError::WhiteSpace),
            ("knee\u{a0}", NameError::WhiteSpace),
            ("a\nb", NameError::Invisible('\n')),
            ("a\u{202e}b", NameError::Invisible('\u{202e}')),
            ("kn\u{200b}ee", NameError::Invisible('\u{200b}')),
            ("10.0.0.2", NameError::Address),
            ("10.0.0.2/80000001", NameError::Address),
            ("0x10", NameError::Number),
            ("0x", NameError::Number),
        ] {
            assert_eq!(check_name(name), Err(why), "{name:?}");
        }
        assert_eq!(check_name(&"x".repeat(64)), Err(NameError::TooLong(64)));
    }

    #[test]
    fn node_name_unusable_in_directory_or_shell_is_rejected() {
        for (name, why) in [
            ("a/b", NameError::File('/')),
            ("a=b", NameError::File('=')),
            ("-x", NameError::First('-')),
            ("..", NameError::First('.')),
            (".hidden", NameError::First('.')),
            ("x.toml", NameError::Toml),
            ("a|b", NameError::Reserved('|')),
        ] {
            assert_eq!(check_node_name(name), Err(why), "{name:?}");
        }
        for name in ["knee", "left-knee.2", "_test", "Knie 2", "膝", "0xy", "sync manager"] {
            assert_eq!(check_node_name(name), Ok(()), "{name:?}");
        }
    }

    #[test]
    fn invisible_characters_are_shown_escaped() {
        assert_eq!(shown("knee\u{202e}x\n\u{200b}é"), "knee\\u{202e}x\\u{a}\\u{200b}é");
    }

    proptest! {
        #[test]
        fn each_legal_name_is_a_requirement_of_itself(name in "\\PC{0,40}") {
            if check_name(&name).is_ok() {
                let requirement: Requirement = name.parse().unwrap();
                prop_assert_eq!(requirement.only_name(), Some(name.as_str()));
            }
        }
    }
}
