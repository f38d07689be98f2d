//! Every byte format that comes from outside, each as one function that takes any bytes, panics where a promise is broken, and says
//! whether it understood any of them.
//!
//! The same functions are played by libFuzzer, which chooses bytes by what they reach (`fuzz/`), by the program `sweep`, which changes known
//! ones by chance and needs nothing but this compiler, and by the tests, which play all that is kept in `fuzz/corpus/`.

mod files;
mod frames;
mod mutation;

use std::{io, path::Path};

pub use mutation::mutate;

/// A byte format.
#[derive(Clone, Copy, Debug)]
pub struct Format {
    /// Its name: that of its target in `fuzz/`, and of its directory of inputs.
    pub name: &'static str,
    /// Who writes such bytes, for people.
    pub from: &'static str,
    /// Plays bytes. Returns whether anything in them was understood.
    pub play: fn(&[u8]) -> bool,
    seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
pub const FORMATS: [Format; 18] = [
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
        name: "topology",
        from: "a person, in a file",
        play: files::topology,
        seeds: files::some_topologies,
    },
];

impl Format {
    /// The one of this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        FORMATS.into_iter().find(|format| format.name == name)
    }

    /// Inputs to begin with: what the other side of the format writes, and what is kept in its directory of `corpus`.
    ///
    /// # Errors
    /// That directory cannot be read, or is not there.
    pub fn inputs(&self, corpus: &Path) -> io::Result<Vec<Vec<u8>>> {
        let mut inputs = (self.seeds)();
        let kept = corpus.join(self.name);
        let read = std::fs::read_dir(&kept);
        // Without what is kept a run tries less, and would look the same.
        let read = read.map_err(|error| {
            let what = format!(
                "no inputs of {} in {}: {error}; name the directory with --corpus",
                self.name,
                kept.display()
            );
            io::Error::new(error.kind(), what)
        })?;
        let mut paths = read.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        // The same seed means the same run, whatever order the system has.
        paths.sort();
        for path in paths {
            inputs.push(std::fs::read(path)?);
        }
        Ok(inputs)
    }

    /// What the other side of the format writes.
    #[must_use]
    pub fn seeds(&self) -> Vec<Vec<u8>> {
        (self.seeds)()
    }
}

/// A hostile peer in shared memory whose every act a script chooses, and when this side acts between them.
fn ring(script: &[u8]) -> bool {
    sinew_shm::hostile::play(script).writes > 0
}

fn some_scripts() -> Vec<Vec<u8>> {
    vec![(0..=255).collect(), (0..=255).rev().collect()]
}
