//! Every byte format that the project reads from outside, each as one function. The function accepts any
//! bytes, panics if an invariant is broken, and returns whether it understood any of them.
//!
//! Three drivers call the same functions:
//!
//! - libFuzzer, which selects inputs by code coverage (`fuzz/`);
//! - the program `sweep`, which mutates known inputs at random and needs only this compiler;
//! - the tests, which replay everything in `fuzz/corpus/`.

mod files;
mod frames;
mod mutation;
mod recordings;

use std::{io, path::Path};

pub use mutation::mutate;

/// A byte format.
#[derive(Clone, Copy, Debug)]
pub struct Format {
    /// The name, also of its fuzz target in `fuzz/` and of its input directory.
    pub name: &'static str,
    /// The origin of such bytes, for people.
    pub from: &'static str,
    /// Runs the bytes through the format. Returns whether any part of them was understood.
    pub play: fn(&[u8]) -> bool,
    seeds: fn() -> Vec<Vec<u8>>,
}

/// All formats.
pub const FORMATS: [Format; 20] = [
    Format {
        name: "header",
        from: "a peer, by TCP or UDP",
        play: frames::header,
        seeds: frames::some_headers,
    },
    Format { name: "frames", from: "a peer, by TCP", play: frames::frames, seeds: frames::some_frames },
    Format {
        name: "handshake",
        from: "a stranger, by TCP",
        play: sinew::fuzzing::handshake,
        seeds: || sinew::fuzzing::seeds("handshake"),
    },
    Format {
        name: "links",
        from: "strangers and peers, in any order",
        play: sinew::fuzzing::links,
        seeds: || sinew::fuzzing::seeds("links"),
    },
    Format {
        name: "session",
        from: "a peer, on a link",
        play: sinew::fuzzing::session,
        seeds: || sinew::fuzzing::seeds("session"),
    },
    Format {
        name: "datagrams",
        from: "anybody, by UDP",
        play: sinew::fuzzing::datagrams,
        seeds: || sinew::fuzzing::seeds("datagrams"),
    },
    Format {
        name: "discovery",
        from: "anybody, by UDP and multicast",
        play: sinew::fuzzing::discovery,
        seeds: || sinew::fuzzing::seeds("discovery"),
    },
    Format {
        name: "peers",
        from: "a disk, or who can write to it",
        play: sinew::fuzzing::peers,
        seeds: || sinew::fuzzing::seeds("peers"),
    },
    Format {
        name: "seals",
        from: "anybody, by UDP, in a project with keys",
        play: sinew::fuzzing::seals,
        seeds: || sinew::fuzzing::seeds("seals"),
    },
    Format {
        name: "protected",
        from: "whatever lies between a sender and an output",
        play: sinew::fuzzing::protected,
        seeds: || sinew::fuzzing::seeds("protected"),
    },
    Format {
        name: "control",
        from: "a client, at the node's door",
        play: sinew::fuzzing::control,
        seeds: || sinew::fuzzing::seeds("control"),
    },
    Format {
        name: "words",
        from: "layers of other nodes, child processes",
        play: sinew::fuzzing::words,
        seeds: || sinew::fuzzing::seeds("words"),
    },
    Format {
        name: "schemas",
        from: "a node, a client, or a recording",
        play: files::schema,
        seeds: files::some_schemas,
    },
    Format { name: "ring", from: "a client, in shared memory", play: ring, seeds: some_scripts },
    Format {
        name: "configuration",
        from: "a person, in files and variables",
        play: files::configuration,
        seeds: files::some_configurations,
    },
    Format {
        name: "access",
        from: "a person, in the access list's file",
        play: sinew::fuzzing::access,
        seeds: || sinew::fuzzing::seeds("access"),
    },
    Format {
        name: "certificate",
        from: "a stranger, in the handshake of TLS",
        play: files::certificate,
        seeds: files::some_certificates,
    },
    Format { name: "trial", from: "a person, in a file", play: files::trial, seeds: files::some_trials },
    Format {
        name: "recording",
        from: "a person, in a file",
        play: recordings::recording,
        seeds: recordings::some_recordings,
    },
    Format {
        name: "topology",
        from: "a person, in a file",
        play: files::topology,
        seeds: files::some_topologies,
    },
];

impl Format {
    /// The format with this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        FORMATS.into_iter().find(|format| format.name == name)
    }

    /// Initial inputs: the built-in seeds, and the files in the format's directory of `corpus`.
    ///
    /// # Errors
    /// The directory cannot be read or does not exist.
    pub fn inputs(&self, corpus: &Path) -> io::Result<Vec<Vec<u8>>> {
        let mut inputs = (self.seeds)();
        let kept = corpus.join(self.name);
        let read = std::fs::read_dir(&kept);
        // A run without the corpus would test less and look the same.
        let read = read.map_err(|error| {
            let what = format!(
                "no inputs of {} in {}: {error}; name the directory with --corpus",
                self.name,
                kept.display()
            );
            io::Error::new(error.kind(), what)
        })?;
        let mut paths = read.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        // Sorted, so that the same seed gives the same run on every system.
        paths.sort();
        for path in paths {
            inputs.push(std::fs::read(path)?);
        }
        Ok(inputs)
    }

    /// The built-in seed inputs: bytes produced by the writing side of the format.
    #[must_use]
    pub fn seeds(&self) -> Vec<Vec<u8>> {
        (self.seeds)()
    }
}

/// A hostile peer in shared memory. A script chooses each of its actions, and the points at which this side
/// runs.
fn ring(script: &[u8]) -> bool {
    sinew_shm::hostile::play(script).writes > 0
}

fn some_scripts() -> Vec<Vec<u8>> {
    vec![(0..=255).collect(), (0..=255).rev().collect()]
}
