//! Payloads in MessagePack: a reader without allocation, and their JSON text.

#![expect(clippy::wildcard_enum_match_arm, reason = "most values are neither list nor map")]

use std::fmt::Write as _;

/// Maximum nesting of a payload, as in a node.
pub(crate) const DEPTH_MAX: usize = 64;

/// A payload that is no MessagePack value, or another one than its schema says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MisfitError {
    /// The expectation that was not met.
    pub(crate) expected: &'static str,
}

impl MisfitError {
    pub(crate) const fn new(expected: &'static str) -> Self {
        Self { expected }
    }
}

/// One value, or the head of a list or map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Token<'p> {
    Nil,
    Bool(bool),
    Unsigned(u64),
    /// Below zero.
    Negative(i64),
    Float(f32),
    Double(f64),
    Text(&'p str),
    Bytes(&'p [u8]),
    List(u32),
    Map(u32),
    Extension(i8, &'p [u8]),
}

/// Reads values one after the other.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reader<'p> {
    rest: &'p [u8],
}

impl<'p> Reader<'p> {
    pub(crate) const fn new(payload: &'p [u8]) -> Self {
        Self { rest: payload }
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }

    /// Skips a nil, if it is next.
    pub(crate) fn skip_nil(&mut self) -> bool {
        let is_nil = self.rest.first() == Some(&0xc0);
        if is_nil {
            self.rest = &self.rest[1..];
        }
        is_nil
    }

    fn take(&mut self, length: u32) -> Result<&'p [u8], MisfitError> {
        let parts = self.rest.split_at_checked(length as usize);
        let (bytes, rest) = parts.ok_or(MisfitError::new("more bytes"))?;
        self.rest = rest;
        Ok(bytes)
    }

    /// Returns an unsigned number of `size` bytes, at most 8.
    fn number(&mut self, size: u32) -> Result<u64, MisfitError> {
        Ok(self.take(size)?.iter().fold(0, |all, byte| all << 8 | u64::from(*byte)))
    }

    fn length(&mut self, size: u32) -> Result<u32, MisfitError> {
        // At most 4 bytes are asked for.
        Ok(self.number(size)? as u32)
    }

    fn signed(&mut self, size: u32) -> Result<Token<'p>, MisfitError> {
        let unused = 64 - 8 * size;
        let value = (self.number(size)? << unused) as i64 >> unused;
        Ok(u64::try_from(value).map_or(Token::Negative(value), Token::Unsigned))
    }

    fn text(&mut self, length: u32) -> Result<Token<'p>, MisfitError> {
        let text = std::str::from_utf8(self.take(length)?).map_err(|_| MisfitError::new("text in UTF-8"))?;
        Ok(Token::Text(text))
    }

    fn extension(&mut self, length: u32) -> Result<Token<'p>, MisfitError> {
        let kind = self.number(1)? as i8;
        Ok(Token::Extension(kind, self.take(length)?))
    }

    /// Reads the next value, or the head of a list or map.
    pub(crate) fn next(&mut self) -> Result<Token<'p>, MisfitError> {
        let marker = self.number(1)? as u8;
        Ok(match marker {
            0x00..=0x7f => Token::Unsigned(marker.into()),
            0x80..=0x8f => Token::Map(u32::from(marker & 0x0f)),
            0x90..=0x9f => Token::List(u32::from(marker & 0x0f)),
            0xa0..=0xbf => self.text(u32::from(marker & 0x1f))?,
            0xc0 => Token::Nil,
            0xc1 => return Err(MisfitError::new("a value of MessagePack")),
            0xc2 => Token::Bool(false),
            0xc3 => Token::Bool(true),
            0xc4..=0xc6 => {
                let length = self.length(1 << (marker - 0xc4))?;
                Token::Bytes(self.take(length)?)
            }
            0xc7..=0xc9 => {
                let length = self.length(1 << (marker - 0xc7))?;
                self.extension(length)?
            }
            0xca => Token::Float(f32::from_bits(self.length(4)?)),
            0xcb => Token::Double(f64::from_bits(self.number(8)?)),
            0xcc..=0xcf => Token::Unsigned(self.number(1 << (marker - 0xcc))?),
            0xd0..=0xd3 => self.signed(1 << (marker - 0xd0))?,
            0xd4..=0xd8 => self.extension(1 << (marker - 0xd4))?,
            0xd9..=0xdb => {
                let length = self.length(1 << (marker - 0xd9))?;
                self.text(length)?
            }
            0xdc | 0xdd => Token::List(self.length(2 << (marker - 0xdc))?),
            0xde | 0xdf => Token::Map(self.length(2 << (marker - 0xde))?),
            0xe0..=0xff => Token::Negative(i64::from(marker as i8)),
        })
    }

    /// Skips the next value with all that is in it.
    pub(crate) fn skip(&mut self) -> Result<(), MisfitError> {
        let mut open = 1_u64;
        while open > 0 {
            open -= 1;
            match self.next()? {
                Token::List(count) => open += u64::from(count),
                Token::Map(count) => open += 2 * u64::from(count),
                _ => {}
            }
        }
        Ok(())
    }
}

/// Writes the next value as JSON. Numbers without a JSON form become text (`"NaN"`), bytes become base64, and keys that
/// are no text become text. A list or a map in a key has neither lists nor maps.
pub(crate) fn json(reader: &mut Reader<'_>, depth: usize, out: &mut String) -> Result<(), MisfitError> {
    let token = reader.next()?;
    match token {
        Token::List(_) | Token::Map(_) if depth == 0 => return Err(MisfitError::new("less nesting")),
        Token::List(count) => {
            out.push('[');
            for at in 0..count {
                separate(at, out);
                json(reader, depth - 1, out)?;
            }
            out.push(']');
        }
        Token::Map(count) => {
            out.push('{');
            json_members(reader, count, depth - 1, out)?;
            out.push('}');
        }
        _ => json_scalar(token, out),
    }
    Ok(())
}

fn separate(at: u32, out: &mut String) {
    if at > 0 {
        out.push(',');
    }
}

/// Writes the members of a map, without the braces.
pub(crate) fn json_members(
    reader: &mut Reader<'_>,
    count: u32,
    depth: usize,
    out: &mut String,
) -> Result<(), MisfitError> {
    for at in 0..count {
        separate(at, out);
        let mut ahead = *reader;
        match ahead.next()? {
            Token::Text(key) => {
                *reader = ahead;
                json_text(key, out);
            }
            _ => {
                let mut key = String::new();
                // Each level of nested keys would double the backslashes.
                json(reader, depth.min(1), &mut key)?;
                json_text(&key, out);
            }
        }
        out.push(':');
        json(reader, depth, out)?;
    }
    Ok(())
}

fn json_scalar(token: Token<'_>, out: &mut String) {
    // Writing to a string cannot fail.
    let _ = match token {
        Token::Bool(value) => write!(out, "{value}"),
        Token::Unsigned(value) => write!(out, "{value}"),
        Token::Negative(value) => write!(out, "{value}"),
        Token::Float(value) if value.is_finite() => write!(out, "{value:?}"),
        Token::Float(value) => write!(out, "\"{}\"", non_finite(value.into())),
        Token::Double(value) if value.is_finite() => write!(out, "{value:?}"),
        Token::Double(value) => write!(out, "\"{}\"", non_finite(value)),
        Token::Text(text) => {
            json_text(text, out);
            Ok(())
        }
        Token::Bytes(bytes) => write!(out, "\"{}\"", base64(bytes)),
        Token::Extension(kind, bytes) => write!(out, "{{\"type\":{kind},\"bytes\":\"{}\"}}", base64(bytes)),
        Token::Nil | Token::List(_) | Token::Map(_) => write!(out, "null"),
    };
}

/// Returns the name of a number that JSON cannot write, as protocol buffers spell it in JSON.
pub(crate) fn non_finite(value: f64) -> &'static str {
    match value {
        _ if value.is_nan() => "NaN",
        _ if value > 0.0 => "Infinity",
        _ => "-Infinity",
    }
}

/// Writes a text with its quotes.
pub(crate) fn json_text(text: &str, out: &mut String) {
    out.push('"');
    for character in text.chars() {
        match character {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            control if control < ' ' => {
                let _ = write!(out, "\\u{:04x}", u32::from(control));
            }
            other => out.push(other),
        }
    }
    out.push('"');
}

/// Returns bytes in base64 (RFC 4648, with padding).
pub(crate) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let bits = (0..3).fold(0_u32, |bits, at| bits << 8 | u32::from(group.get(at).copied().unwrap_or(0)));
        for at in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * at) & 0x3f) as usize];
            text.push(if at > group.len() { '=' } else { char::from(digit) });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn shown(bytes: &[u8]) -> Result<String, MisfitError> {
        let mut text = String::new();
        json(&mut Reader::new(bytes), DEPTH_MAX, &mut text).map(|()| text)
    }

    #[test]
    fn values_are_shown_exactly() {
        let value = serde_json::json!({
            "big": u64::MAX, "small": i64::MIN, "list": [null, true, -1, -33, 300, 70_000], "text": "a\"\\\n\u{1}é",
            "half": 0.5,
        });
        let bytes = rmp_serde::to_vec_named(&value).unwrap();
        assert_eq!(serde_json::from_str::<serde_json::Value>(&shown(&bytes).unwrap()).unwrap(), value);
    }

    #[test]
    fn values_without_json_form_become_text() {
        assert_eq!(shown(&[0x81, 0x01, 0xc4, 2, 0x0a, 0xff]).unwrap(), r#"{"1":"Cv8="}"#);
        let floats = rmp_serde::to_vec(&(f32::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.1_f32)).unwrap();
        assert_eq!(shown(&floats).unwrap(), r#"["NaN","Infinity","-Infinity",0.1]"#);
        assert_eq!([b"f", &b"fo"[..], b"foo", b"foob"].map(base64), ["Zg==", "Zm8=", "Zm9v", "Zm9vYg=="]);
    }

    #[test]
    fn nesting_is_limited() {
        assert!(shown(&[0x91; 100_000]).is_err());
        assert!(shown(&[0xdd, 0xff, 0xff, 0xff, 0xff]).is_err());
    }

    #[test]
    fn nesting_of_keys_is_limited() {
        let nested = |levels| [vec![0x81_u8; levels], vec![0x01_u8; levels + 1]].concat();
        assert_eq!(shown(&nested(2)).unwrap(), r#"{"{\"1\":1}":1}"#);
        assert!(shown(&nested(60)).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_skipped_or_refused(bytes: Vec<u8>) {
            let (mut skipped, mut text) = (Reader::new(&bytes), String::new());
            let read = json(&mut Reader::new(&bytes), DEPTH_MAX, &mut text);
            if read.is_ok() {
                prop_assert!(serde_json::from_str::<serde_json::Value>(&text).is_ok(), "{text}");
                prop_assert!(skipped.skip().is_ok());
            }
        }
    }
}
