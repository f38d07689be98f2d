//! The parser of `.msg` and `.srv` texts.

use std::fmt;

use crate::{
    catalog::Count,
    name::{TypeName, is_word},
};

/// Maximum bytes of a text.
const TEXT_BYTES_MAX: usize = 65_536;
/// Maximum fields of a message.
const FIELDS_MAX: usize = 256;
/// Maximum length of an array, and of a bounded sequence or text.
pub(crate) const LENGTH_MAX: u32 = 65_536;
/// The member of a message without fields: a structure of DDS has at least one.
const DUMMY: &str = "structure_needs_at_least_one_member";

/// The fault of a text that is no definition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DefinitionError {
    name: String,
    /// From 1 on; 0: the text as a whole.
    line: usize,
    why: String,
}

impl fmt::Display for DefinitionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, line, why } = self;
        match line {
            0 => write!(f, "{name}: {why}"),
            _ => write!(f, "{name}, line {line}: {why}"),
        }
    }
}

impl std::error::Error for DefinitionError {}

/// The element type of a field, with the names of other messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Base {
    Bool,
    Byte,
    Signed(u8),
    /// With its bits, as the others.
    Unsigned(u8),
    Float(u8),
    /// With the maximum bytes; `None`: without a limit.
    Text(Option<u32>),
    Message(TypeName),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) base: Base,
    pub(crate) count: Count,
}

/// A parsed message, or one half of a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Definition {
    pub(crate) name: TypeName,
    pub(crate) fields: Vec<Field>,
}

/// Parses a `.msg` text. Constants, defaults and comments are left out: they are not on the wire.
pub(crate) fn parse_message(name: &TypeName, text: &str) -> Result<Definition, DefinitionError> {
    check_length(name, text)?;
    parse_lines(name, text.lines().enumerate())
}

/// Parses a `.srv` text into its request and its response.
pub(crate) fn parse_service(
    name: &TypeName,
    text: &str,
) -> Result<(Definition, Definition), DefinitionError> {
    check_length(name, text)?;
    let is_border = |line: &str| line.trim() == "---";
    let whole = |why: &str| DefinitionError { name: name.to_string(), line: 0, why: why.to_owned() };
    let border = text.lines().position(is_border).ok_or_else(|| whole("a service has one line '---'"))?;
    if text.lines().skip(border + 1).any(is_border) {
        return Err(whole("a service has one line '---'; actions are not supported"));
    }
    let lines = || text.lines().enumerate();
    let request = parse_lines(&name.with_suffix("_Request"), lines().take(border))?;
    let response = parse_lines(&name.with_suffix("_Response"), lines().skip(border + 1))?;
    Ok((request, response))
}

fn check_length(name: &TypeName, text: &str) -> Result<(), DefinitionError> {
    if text.len() <= TEXT_BYTES_MAX {
        return Ok(());
    }
    let why = format!("it has {} bytes, more than {TEXT_BYTES_MAX}", text.len());
    Err(DefinitionError { name: name.to_string(), line: 0, why })
}

fn parse_lines<'t>(
    name: &TypeName,
    lines: impl Iterator<Item = (usize, &'t str)>,
) -> Result<Definition, DefinitionError> {
    let mut fields: Vec<Field> = Vec::new();
    for (at, line) in lines {
        let fault = |why: String| DefinitionError { name: name.to_string(), line: at + 1, why };
        let Some(field) = parse_line(line, name.package()).map_err(fault)? else { continue };
        if fields.iter().any(|known| known.name == field.name) {
            return Err(fault(format!("the field '{}' stands twice", field.name)));
        }
        if fields.len() == FIELDS_MAX {
            return Err(fault(format!("a message has at most {FIELDS_MAX} fields")));
        }
        fields.push(field);
    }
    if fields.is_empty() {
        fields.push(Field { name: DUMMY.to_owned(), base: Base::Unsigned(8), count: Count::One });
    }
    Ok(Definition { name: name.clone(), fields })
}

/// Returns the field of a line; `None` for a constant, a comment or an empty line.
fn parse_line(line: &str, package: &str) -> Result<Option<Field>, String> {
    let line = line.split('#').next().unwrap_or_default().trim();
    if line.is_empty() {
        return Ok(None);
    }
    let (type_text, rest) = line
        .split_once(char::is_whitespace)
        .ok_or_else(|| format!("'{}' has no name behind its type", shown(line)))?;
    let (base, count) = parse_type(type_text, package)?;
    let rest = rest.trim_start();
    let end = rest.find(|c: char| c.is_whitespace() || c == '=').unwrap_or(rest.len());
    let (name, behind) = rest.split_at(end);
    if !is_word(name) {
        return Err(format!("'{}' is no name of a field: letters, digits and '_'", shown(name)));
    }
    if behind.trim_start().starts_with('=') {
        return match (base, count) {
            (Base::Message(_), _) | (_, Count::Array(_) | Count::Bounded(_) | Count::Unbounded) => {
                Err(format!("the constant '{}' is no number, text or truth", shown(name)))
            }
            _ => Ok(None),
        };
    }
    // Behind the name is a default, which only constructors use.
    Ok(Some(Field { name: name.to_owned(), base, count }))
}

fn parse_type(text: &str, package: &str) -> Result<(Base, Count), String> {
    let (base, count) = match text.strip_suffix(']') {
        None => (text, Count::One),
        Some(text) => {
            let (base, length) =
                text.rsplit_once('[').ok_or_else(|| format!("'{}' has no '['", shown(text)))?;
            let count = match length.strip_prefix("<=") {
                Some(max) => Count::Bounded(parse_length(max)?),
                None if length.is_empty() => Count::Unbounded,
                None => Count::Array(parse_length(length)?),
            };
            (base, count)
        }
    };
    Ok((parse_base(base, package)?, count))
}

fn parse_base(text: &str, package: &str) -> Result<Base, String> {
    Ok(match text {
        "bool" => Base::Bool,
        "byte" => Base::Byte,
        "int8" => Base::Signed(8),
        "int16" => Base::Signed(16),
        "int32" => Base::Signed(32),
        "int64" => Base::Signed(64),
        // `rosidl` reads `char` as `uint8`.
        "uint8" | "char" => Base::Unsigned(8),
        "uint16" => Base::Unsigned(16),
        "uint32" => Base::Unsigned(32),
        "uint64" => Base::Unsigned(64),
        "float32" => Base::Float(32),
        "float64" => Base::Float(64),
        "string" => Base::Text(None),
        _ if text.starts_with("wstring") => return Err("wstring is not supported; use string".to_owned()),
        _ => match text.strip_prefix("string<=") {
            Some(max) => Base::Text(Some(parse_length(max)?)),
            None => Base::Message(TypeName::referred(text, package).map_err(|why| why.to_string())?),
        },
    })
}

fn parse_length(text: &str) -> Result<u32, String> {
    let length = text.parse().ok().filter(|length| (1..=LENGTH_MAX).contains(length));
    length.ok_or_else(|| format!("'{}' is no length from 1 to {LENGTH_MAX}", shown(text)))
}

fn shown(text: &str) -> String {
    text.chars().filter(|character| !character.is_control()).take(64).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn parse(text: &str) -> Result<Definition, DefinitionError> {
        parse_message(&TypeName::parse("demo_msgs/msg/Any").expect("a name"), text)
    }

    #[test]
    fn fields_have_types_and_counts() {
        let text = "# a comment\nuint8 OK=0\nstring NAME = \"a # b\"\n\nfloat64 x 1.5 # default\nint16[3] a\n\
                    string<=8[<=4] b\nOther[] c\nstd_msgs/Header header\nbool d";
        let fields = parse(text).expect("a definition").fields;
        let shown: Vec<_> = fields.iter().map(|field| (field.name.as_str(), field.count)).collect();
        let expected = [
            ("x", Count::One),
            ("a", Count::Array(3)),
            ("b", Count::Bounded(4)),
            ("c", Count::Unbounded),
            ("header", Count::One),
            ("d", Count::One),
        ];
        assert_eq!(shown, expected);
        assert_eq!(fields[2].base, Base::Text(Some(8)));
        assert_eq!(fields[3].base, Base::Message(TypeName::parse("demo_msgs/msg/Other").expect("a name")));
    }

    #[test]
    fn malformed_lines_are_named() {
        for (text, words) in [
            ("float64", "no name"),
            ("float64[ x", "capital"),
            ("float64] x", "no '['"),
            ("float64[0] x", "no length"),
            ("float64[99999999999] x", "no length"),
            ("float64 2x", "no name of a field"),
            ("float64 x\nfloat64 x", "stands twice"),
            ("wstring x", "not supported"),
            ("float64[2] X=1", "constant"),
            ("a*b x", "capital"),
        ] {
            let why = parse(text).expect_err(text).to_string();
            assert!(why.contains(words) && why.contains("line"), "{text}: {why}");
        }
    }

    #[test]
    fn long_texts_and_many_fields_are_refused() {
        assert!(parse(&"#".repeat(TEXT_BYTES_MAX + 1)).is_err());
        let many: String = (0..=FIELDS_MAX).map(|at| format!("bool f{at}\n")).collect();
        assert!(parse(&many).expect_err("too many").to_string().contains("at most 256"));
    }

    #[test]
    fn service_has_two_halves() {
        let name = TypeName::parse("std_srvs/srv/Trigger").expect("a name");
        let (request, response) =
            parse_service(&name, "---\nbool success\nstring message").expect("a service");
        assert_eq!(request.fields[0].name, DUMMY);
        assert_eq!(response.name.as_str(), "std_srvs/srv/Trigger_Response");
        assert!(parse_service(&name, "bool x").is_err() && parse_service(&name, "---\n---").is_err());
    }

    proptest! {
        #[test]
        fn any_text_is_parsed_or_refused(text in "[ -~\n]{0,200}") {
            let _ = parse(&text);
            let _ = parse_service(&TypeName::parse("a/srv/B").expect("a name"), &text);
        }
    }
}
