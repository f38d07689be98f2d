//! Doors for fuzzers to parsers and cores that nobody else may call: there with the feature `fuzzing` alone, never in a robot.
//!
//! Each takes any bytes, panics where a promise about them is broken, and says whether anything in them was understood: a
//! target whose seeds are not understood tries nothing. What is checked stands beside what it checks, in each layer's `fuzzing`.

/// HELLO, WELCOME and REFUSAL: payloads of the handshake between nodes.
#[must_use]
pub fn handshake(bytes: &[u8]) -> bool {
    crate::gncl::fuzzing::handshake(bytes)
}

/// A script of what happens to connections and peers, played to a live core of GNCL.
#[must_use]
pub fn links(script: &[u8]) -> bool {
    crate::gncl::fuzzing::links(script)
}

/// A script of frames between two nodes, damaged and lost ones too, played to both halves of a live session.
#[must_use]
pub fn session(script: &[u8]) -> bool {
    crate::session::fuzzing::session(script)
}

/// Datagrams for values of class Stream.
#[must_use]
pub fn datagrams(bytes: &[u8]) -> bool {
    crate::gncl::fuzzing::datagrams(bytes)
}

/// Datagrams of discovery, sealed and not.
#[must_use]
pub fn discovery(bytes: &[u8]) -> bool {
    crate::ndl::fuzzing::discovery(bytes)
}

/// The file in which a node keeps where its peers answered.
#[must_use]
pub fn peers(bytes: &[u8]) -> bool {
    crate::ndl::fuzzing::peers(bytes)
}

/// A script of sealed datagrams of discovery, honest, forged, damaged and sent again, played to a live checker of seals.
#[must_use]
pub fn seals(script: &[u8]) -> bool {
    crate::secured::fuzzing::seals(script)
}

/// A script of protected messages and echoes, honest, lost, held up, damaged and forged, played to a live receiver.
#[must_use]
pub fn protected(script: &[u8]) -> bool {
    sinew_runtime::protection::fuzzing::protected(script)
}

/// The file of an access list.
#[must_use]
pub fn access(bytes: &[u8]) -> bool {
    crate::access::fuzzing::access(bytes)
}

/// Frames of a client at the node's door, in any state of its connection.
#[must_use]
pub fn control(bytes: &[u8]) -> bool {
    crate::lncl::fuzzing::control(bytes)
}

/// What layers of different nodes, and a node and its child processes, say to each other.
#[must_use]
pub fn words(bytes: &[u8]) -> bool {
    let Some((which, bytes)) = bytes.split_first() else { return false };
    let readers: [fn(&[u8]) -> bool; 6] = [
        crate::sync::fuzzing::words,
        crate::monitors::fuzzing::words,
        crate::wills::fuzzing::words,
        crate::audit::fuzzing::words,
        crate::process::fuzzing::words,
        crate::outlet::fuzzing::words,
    ];
    readers[usize::from(*which) % readers.len()](bytes)
}

/// Bytes that all of these understand, as they are written by their own side: what a fuzzer begins with.
#[must_use]
pub fn seeds(format: &str) -> Vec<Vec<u8>> {
    match format {
        "handshake" => crate::gncl::fuzzing::handshakes(),
        "links" => vec![crate::gncl::fuzzing::A_LINK.to_vec()],
        "session" => vec![crate::session::fuzzing::A_SESSION.to_vec()],
        "datagrams" => crate::gncl::fuzzing::some_datagrams(),
        "discovery" => crate::ndl::fuzzing::some_datagrams(),
        "peers" => crate::ndl::fuzzing::some_peers(),
        "seals" => vec![crate::secured::fuzzing::SOME_SEALS.to_vec()],
        "protected" => vec![sinew_runtime::protection::fuzzing::SOME_MESSAGES.to_vec()],
        "access" => crate::access::fuzzing::some_lists(),
        "control" => crate::lncl::fuzzing::some_frames(),
        "words" => {
            let said = [
                crate::sync::fuzzing::said(),
                crate::monitors::fuzzing::said(),
                crate::wills::fuzzing::said(),
                crate::audit::fuzzing::said(),
                crate::process::fuzzing::said(),
                crate::outlet::fuzzing::said(),
            ];
            let numbered = said.into_iter().zip(0_u8..);
            numbered
                .flat_map(|(said, which)| said.into_iter().map(move |bytes| [&[which][..], &bytes].concat()))
                .collect()
        }
        _ => Vec::new(),
    }
}

/// Bytes that decide what happens next, one after the other; behind their end all are 0.
pub(crate) struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(crate) const fn is_over(&self) -> bool {
        self.0.is_empty()
    }

    pub(crate) fn byte(&mut self) -> u8 {
        let [byte] = self.take();
        byte
    }

    /// A number that is small, or one of the largest: those between are like each other.
    pub(crate) fn number(&mut self) -> u64 {
        match self.byte() {
            near @ 0..=0xef => u64::from(near),
            far => u64::MAX - u64::from(0xff - far),
        }
    }

    /// So many bytes at most.
    pub(crate) fn bytes(&mut self, count: usize) -> &'a [u8] {
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

/// What this reads of any bytes it writes so that it reads the same again. Returns whether it reads anything.
pub(crate) fn is_read_as_written<T>(bytes: &[u8]) -> bool
where
    T: serde::Serialize + serde::de::DeserializeOwned + PartialEq + std::fmt::Debug,
{
    let Ok(read) = sinew_runtime::wire::decode::<T>(bytes) else { return false };
    let written = rmp_serde::to_vec_named(&read).expect("what was read can be written");
    let again = sinew_runtime::wire::decode::<T>(&written);
    assert_eq!(again.expect("what was written can be read"), read);
    true
}
