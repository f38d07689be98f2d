//! Entry points for fuzzers to internal parsers and cores. They exist only with the feature `fuzzing`, never
//! in a robot.
//!
//! Each accepts any bytes, panics if a promised property is violated, and returns whether any part of the
//! bytes was valid: a target with only invalid seeds tests nothing. The checks are next to the checked code,
//! in each layer's `fuzzing`.

/// Tests HELLO, WELCOME and REFUSAL: payloads of the handshake between nodes.
#[must_use]
pub fn handshake(bytes: &[u8]) -> bool {
    sinew_gncl::fuzzing::handshake(bytes)
}

/// Runs a script of events on connections and peers with a live core of GNCL.
#[must_use]
pub fn links(script: &[u8]) -> bool {
    sinew_gncl::fuzzing::links(script)
}

/// Runs a script of frames between two nodes, including damaged and lost ones, with both halves of a live session.
#[must_use]
pub fn session(script: &[u8]) -> bool {
    sinew_session::fuzzing::session(script)
}

/// Tests datagrams for values of class Stream.
#[must_use]
pub fn datagrams(bytes: &[u8]) -> bool {
    sinew_gncl::fuzzing::datagrams(bytes)
}

/// Tests datagrams of discovery, sealed and unsealed.
#[must_use]
pub fn discovery(bytes: &[u8]) -> bool {
    sinew_ndl::fuzzing::discovery(bytes)
}

/// Tests the file in which a node stores the addresses at which its peers answered.
#[must_use]
pub fn peers(bytes: &[u8]) -> bool {
    sinew_ndl::fuzzing::peers(bytes)
}

/// Runs a script of sealed datagrams of discovery (valid, forged, damaged, replayed) with a live checker of seals.
#[must_use]
pub fn seals(script: &[u8]) -> bool {
    sinew_security::node_security::fuzzing::seals(script)
}

/// Runs a script of protected messages and echoes (valid, lost, delayed, damaged, forged) with a live receiver.
#[must_use]
pub fn protected(script: &[u8]) -> bool {
    sinew_runtime::protection::fuzzing::protected(script)
}

/// Tests the file of an access list.
#[must_use]
pub fn access(bytes: &[u8]) -> bool {
    sinew_security::access::fuzzing::access(bytes)
}

/// Tests frames of a client at the node's socket, in any state of its connection.
#[must_use]
pub fn control(bytes: &[u8]) -> bool {
    sinew_lncl::fuzzing::control(bytes)
}

/// Tests the frames between layers of different nodes, and between a node and its child processes.
#[must_use]
pub fn words(bytes: &[u8]) -> bool {
    let Some((which, bytes)) = bytes.split_first() else { return false };
    let readers: [fn(&[u8]) -> bool; 7] = [
        sinew_sync::fuzzing::frames,
        sinew_sync::monitors::fuzzing::frames,
        sinew_sync::wills::fuzzing::frames,
        sinew_node::fuzzing::audit::frames,
        sinew_node::fuzzing::process::frames,
        sinew_session::outlet::fuzzing::words,
        sinew_node::fuzzing::types::frames,
    ];
    readers[usize::from(*which) % readers.len()](bytes)
}

/// Returns bytes that all of these accept, as written by their own side: the start corpus of a fuzzer.
#[must_use]
pub fn seeds(format: &str) -> Vec<Vec<u8>> {
    match format {
        "handshake" => sinew_gncl::fuzzing::handshakes(),
        "links" => vec![sinew_gncl::fuzzing::A_LINK.to_vec()],
        "session" => vec![sinew_session::fuzzing::A_SESSION.to_vec()],
        "datagrams" => sinew_gncl::fuzzing::some_datagrams(),
        "discovery" => sinew_ndl::fuzzing::some_datagrams(),
        "peers" => sinew_ndl::fuzzing::some_peers(),
        "seals" => vec![sinew_security::node_security::fuzzing::SOME_SEALS.to_vec()],
        "protected" => vec![sinew_runtime::protection::fuzzing::SOME_MESSAGES.to_vec()],
        "access" => sinew_security::access::fuzzing::some_lists(),
        "control" => sinew_lncl::fuzzing::some_frames(),
        "words" => {
            let samples = [
                sinew_sync::fuzzing::sent_frames(),
                sinew_sync::monitors::fuzzing::sent_frames(),
                sinew_sync::wills::fuzzing::sent_frames(),
                sinew_node::fuzzing::audit::sent_frames(),
                sinew_node::fuzzing::process::sent_frames(),
                sinew_session::outlet::fuzzing::said(),
                sinew_node::fuzzing::types::sent_frames(),
            ];
            let numbered = samples.into_iter().zip(0_u8..);
            numbered
                .flat_map(|(frames, which)| {
                    frames.into_iter().map(move |bytes| [&[which][..], &bytes].concat())
                })
                .collect()
        }
        _ => Vec::new(),
    }
}
