//! The wire format of protocol buffers: writing, and reading the few fields that this package needs again.

/// Wire types.
pub(crate) const VARINT: u32 = 0;
pub(crate) const FIXED64: u32 = 1;
pub(crate) const LENGTH: u32 = 2;
pub(crate) const FIXED32: u32 = 5;

/// A message that is being written.
#[derive(Clone, Debug, Default)]
pub(crate) struct Output(pub(crate) Vec<u8>);

impl Output {
    pub(crate) fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    pub(crate) fn tag(&mut self, number: u32, wire: u32) {
        self.varint(u64::from(number) << 3 | u64::from(wire));
    }

    pub(crate) fn unsigned(&mut self, number: u32, value: u64) {
        self.tag(number, VARINT);
        self.varint(value);
    }

    /// Writes a field of type `sint64` or `sint32`.
    pub(crate) fn signed(&mut self, number: u32, value: i64) {
        self.unsigned(number, zigzag(value));
    }

    pub(crate) fn bytes(&mut self, number: u32, value: &[u8]) {
        self.tag(number, LENGTH);
        self.varint(value.len() as u64);
        self.0.extend_from_slice(value);
    }

    pub(crate) fn text(&mut self, number: u32, value: &str) {
        self.bytes(number, value.as_bytes());
    }

    /// Begins a field with a length that is not known yet. [`end`](Self::end) takes the result.
    pub(crate) fn begin(&mut self, number: u32) -> usize {
        self.tag(number, LENGTH);
        self.0.len()
    }

    /// Puts the length before the content that began at `start`.
    pub(crate) fn end(&mut self, start: usize) {
        let content = self.0.len() - start;
        self.varint(content as u64);
        let prefix = self.0.len() - start - content;
        self.0[start..].rotate_right(prefix);
    }

    /// Writes a field that contains a message.
    pub(crate) fn message(&mut self, number: u32, write: impl FnOnce(&mut Self)) {
        let start = self.begin(number);
        write(self);
        self.end(start);
    }
}

pub(crate) const fn zigzag(value: i64) -> u64 {
    (value << 1 ^ value >> 63) as u64
}

/// The value of a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Value<'m> {
    Number(u64),
    Bytes(&'m [u8]),
}

/// The fields of a message, as far as its bytes are valid.
pub(crate) struct Fields<'m>(pub(crate) &'m [u8]);

impl<'m> Fields<'m> {
    fn varint(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (&byte, rest) = self.0.split_first()?;
            self.0 = rest;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }

    fn take(&mut self, length: u64) -> Option<&'m [u8]> {
        let (bytes, rest) = self.0.split_at_checked(usize::try_from(length).ok()?)?;
        self.0 = rest;
        Some(bytes)
    }
}

impl<'m> Iterator for Fields<'m> {
    type Item = (u32, Value<'m>);

    fn next(&mut self) -> Option<Self::Item> {
        let tag = self.varint()?;
        let number = u32::try_from(tag >> 3).ok()?;
        let little = |bytes: &[u8]| bytes.iter().rev().fold(0, |all, byte| all << 8 | u64::from(*byte));
        let value = match (tag & 7) as u32 {
            VARINT => Value::Number(self.varint()?),
            FIXED64 => Value::Number(little(self.take(8)?)),
            FIXED32 => Value::Number(little(self.take(4)?)),
            LENGTH => {
                let length = self.varint()?;
                Value::Bytes(self.take(length)?)
            }
            _ => return None,
        };
        Some((number, value))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn fields_are_read_as_written() {
        let mut output = Output::default();
        output.unsigned(1, u64::MAX);
        output.message(15_000, |inner| inner.text(2, &"long ".repeat(100)));
        output.signed(3, -1);
        let fields: Vec<_> = Fields(&output.0).collect();
        assert_eq!(fields[0], (1, Value::Number(u64::MAX)));
        assert_eq!(fields[2], (3, Value::Number(1)));
        let (15_000, Value::Bytes(inner)) = fields[1] else { panic!("{fields:?}") };
        assert_eq!(Fields(inner).next(), Some((2, Value::Bytes("long ".repeat(100).as_bytes()))));
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_to_an_end(bytes: Vec<u8>) {
            prop_assert!(Fields(&bytes).count() <= bytes.len());
        }
    }
}
