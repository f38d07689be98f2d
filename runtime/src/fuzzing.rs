//! What the entry points for fuzzers share. It exists only with the feature `fuzzing`, never in a robot.

/// Bytes that decide on the next events, one after the other; all bytes after their end are 0.
pub struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub const fn is_over(&self) -> bool {
        self.0.is_empty()
    }

    pub fn byte(&mut self) -> u8 {
        let [byte] = self.take();
        byte
    }

    /// Returns a number that is small, or one of the largest: those between behave alike.
    pub fn number(&mut self) -> u64 {
        match self.byte() {
            near @ 0..=0xef => u64::from(near),
            far => u64::MAX - u64::from(0xff - far),
        }
    }

    /// Returns at most this many bytes.
    pub fn bytes(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }

    fn take<const N: usize>(&mut self) -> [u8; N] {
        let mut bytes = [0; N];
        let taken = self.bytes(N);
        bytes[..taken.len()].copy_from_slice(taken);
        bytes
    }
}

/// Checks that a decoded value is encoded to bytes that decode to the same value. Returns whether the bytes decode.
pub fn is_read_as_written<T>(bytes: &[u8]) -> bool
where
    T: serde::Serialize + serde::de::DeserializeOwned + PartialEq + std::fmt::Debug,
{
    let Ok(read) = crate::wire::decode::<T>(bytes) else { return false };
    let written = rmp_serde::to_vec_named(&read).expect("what was read can be written");
    let again = crate::wire::decode::<T>(&written);
    assert_eq!(again.expect("what was written can be read"), read);
    true
}
