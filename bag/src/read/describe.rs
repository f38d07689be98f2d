//! The meaning of a recording's channels and headers.

use serde::Serialize;

use super::{Channel, Message};
use crate::{
    protobuf::{Fields, Value},
    terms::{Class, Direction},
    view::HEADER_FIELD,
};

/// Bytes of the envelope of a protected payload: before the value, and behind it (docs/protocol/protected.md).
const ENVELOPE: [usize; 2] = [32, 8];

/// The part that a channel has in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role<'c> {
    /// Payloads as they were sent.
    Raw,
    /// The messages beside the payloads of the channel with this topic.
    Beside(&'c str),
    /// Tallies, clocks, events, or a channel of another program.
    Other,
}

impl Channel {
    /// Returns the part that it has in a recording.
    #[must_use]
    pub fn role(&self) -> Role<'_> {
        match (self.value("role"), self.value("raw")) {
            ("raw", _) => Role::Raw,
            ("view" | "json" | "header", raw) => Role::Beside(raw),
            _ => Role::Other,
        }
    }

    /// Returns a value of the metadata, without `sinew.` in its key; empty where there is none.
    #[must_use]
    pub fn value(&self, key: &str) -> &str {
        self.metadata.get(&format!("sinew.{key}")).map_or("", String::as_str)
    }

    /// Returns the value in a payload of this channel: the bytes in the envelope, if the payloads are protected.
    /// Nothing of the envelope is verified.
    #[must_use]
    pub fn unsealed<'d>(&self, payload: &'d [u8]) -> &'d [u8] {
        if self.value("protected") != "true" {
            return payload;
        }
        let end = payload.len().saturating_sub(ENVELOPE[1]);
        payload.get(ENVELOPE[0]..end).unwrap_or(payload)
    }

    /// Returns the class of its messages.
    #[must_use]
    pub fn class(&self) -> Option<Class> {
        Class::from_text(self.value("class"))
    }

    /// Returns whether the recording node sent its messages.
    #[must_use]
    pub fn direction(&self) -> Option<Direction> {
        Direction::from_text(self.value("direction"))
    }
}

/// The header of a message, as it stands beside the payload.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Header {
    /// The sequence number of the source.
    pub sequence: u64,
    /// Connects a reply or an outcome to its message.
    pub correlation: u64,
    /// The number in its channel.
    pub number: u64,
    /// From sending to handing over, in nanoseconds.
    pub age_ns: i64,
    /// How wrong the age may be, in nanoseconds.
    pub error_ns: u64,
    /// The flags.
    pub flags: u8,
    /// Microseconds after which it expires; 0: never.
    pub time_to_live_us: u32,
    /// The expectation that the payload did not meet, where it does not fit its schema.
    pub misfit: Option<String>,
}

impl Header {
    /// Reads the header from a message of a channel with [`Role::Beside`].
    #[must_use]
    pub fn of(message: &Message<'_>) -> Option<Self> {
        match message.channel.value("role") {
            "header" => Some(Self::read(message.data)),
            "view" => Fields(message.data).find_map(|(number, value)| match value {
                Value::Bytes(bytes) if number == HEADER_FIELD => Some(Self::read(bytes)),
                Value::Bytes(_) | Value::Number(_) => None,
            }),
            "json" => Self::from_json(message.data),
            _ => None,
        }
    }

    fn read(bytes: &[u8]) -> Self {
        let mut header = Self::default();
        for (number, value) in Fields(bytes) {
            match (number, value) {
                (1, Value::Number(value)) => header.sequence = value,
                (2, Value::Number(value)) => header.correlation = value,
                (3, Value::Number(value)) => header.number = value,
                (4, Value::Number(value)) => header.age_ns = (value >> 1) as i64 ^ -((value & 1) as i64),
                (5, Value::Number(value)) => header.error_ns = value,
                (6, Value::Number(value)) => header.flags = value as u8,
                (7, Value::Number(value)) => header.time_to_live_us = value as u32,
                (8, Value::Bytes(text)) => header.misfit = Some(String::from_utf8_lossy(text).into_owned()),
                _ => {}
            }
        }
        header
    }

    fn from_json(text: &[u8]) -> Option<Self> {
        let value: serde_json::Value = serde_json::from_slice(text).ok()?;
        let header = value.get("sinew")?;
        let number = |key: &str| header.get(key).and_then(serde_json::Value::as_u64).unwrap_or(0);
        Some(Self {
            sequence: number("sequence"),
            correlation: number("correlation"),
            number: number("number"),
            age_ns: header.get("age_ns").and_then(serde_json::Value::as_i64).unwrap_or(0),
            error_ns: number("error_ns"),
            flags: number("flags") as u8,
            time_to_live_us: number("time_to_live_us") as u32,
            misfit: None,
        })
    }
}
