//! Messages as values.

use crate::catalog::{Count, Element, Member, Structure};

/// A value of a message. The type of the message has the exact type of each number.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A truth.
    Bool(bool),
    /// An integer with a sign.
    Signed(i64),
    /// An integer without a sign.
    Unsigned(u64),
    /// A number with a fraction.
    Float(f64),
    /// A text.
    Text(String),
    /// The values of an array or a sequence.
    List(Vec<Self>),
    /// The members of a message, in their order.
    Message(Vec<Self>),
}

impl Value {
    /// Returns the value of a message with zeros, empty texts and empty sequences.
    #[must_use]
    pub fn zero(of: &Structure) -> Self {
        Self::Message(of.members.iter().map(Self::zero_member).collect())
    }

    fn zero_member(member: &Member) -> Self {
        match member.count {
            Count::One => Self::zero_element(&member.element),
            // The parser limits the length.
            Count::Array(length) => {
                Self::List((0..length).map(|_| Self::zero_element(&member.element)).collect())
            }
            Count::Bounded(_) | Count::Unbounded => Self::List(Vec::new()),
        }
    }

    /// Returns the zero of one value.
    #[must_use]
    pub fn zero_element(of: &Element) -> Self {
        match of {
            Element::Bool => Self::Bool(false),
            Element::Signed(_) => Self::Signed(0),
            Element::Byte | Element::Unsigned(_) => Self::Unsigned(0),
            Element::Float(_) => Self::Float(0.0),
            Element::Text(_) => Self::Text(String::new()),
            Element::Message(inner) => Self::zero(inner),
        }
    }

    /// Returns a member of a message by its place; a truth for anything else is `None`.
    #[must_use]
    pub fn at(&self, place: usize) -> Option<&Self> {
        match self {
            Self::Message(values) | Self::List(values) => values.get(place),
            Self::Bool(_) | Self::Signed(_) | Self::Unsigned(_) | Self::Float(_) | Self::Text(_) => None,
        }
    }

    /// Returns the values of a list; none of anything else.
    #[must_use]
    pub fn list(&self) -> &[Self] {
        if let Self::List(values) = self { values } else { &[] }
    }

    /// Returns the text; an empty one of anything else.
    #[must_use]
    pub fn text(&self) -> &str {
        if let Self::Text(text) = self { text } else { "" }
    }
}
