//! All hosts of a robot, asked beside each other.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    thread,
};

use super::{
    order::{Hash, NodeOrder},
    plan::Observed,
    protocol::{Answer, NodeSeen, Request},
    robot::Robot,
    session::{Access, HostError, Session},
};

/// Sessions with the hosts of a robot.
#[derive(Debug)]
pub(super) struct Fleet {
    sessions: BTreeMap<String, Session>,
}

/// The sent files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Sent {
    pub(super) files: usize,
    pub(super) bytes: u64,
}

impl Fleet {
    /// Connects to all hosts. Also returns those that cannot be used, with the reason.
    pub(super) fn enter(robot: &Robot, access: Access) -> (Self, BTreeMap<String, HostError>) {
        let opened: Vec<_> = thread::scope(|scope| {
            let hosts = robot.hosts.iter();
            let opening: Vec<_> = hosts
                .map(|(name, host)| {
                    scope.spawn(move || (name.clone(), Session::open(name, host, &robot.name, access)))
                })
                .collect();
            opening.into_iter().map(|thread| thread.join().expect("a session does not panic")).collect()
        });
        let (mut sessions, mut errors) = (BTreeMap::new(), BTreeMap::new());
        for (name, opened) in opened {
            match opened {
                Ok(session) => _ = sessions.insert(name, session),
                Err(why) => _ = errors.insert(name, why),
            }
        }
        (Self { sessions }, errors)
    }

    /// Returns the names of the hosts with a session.
    pub(super) fn hosts(&self) -> Vec<String> {
        self.sessions.keys().cloned().collect()
    }

    /// Returns the folder of the robot on a host.
    pub(super) fn folder(&self, host: &str) -> &Path {
        self.sessions.get(host).map_or_else(|| Path::new("/"), |session| session.folder.as_path())
    }

    /// Returns the nodes with files on these hosts, beside each other; `None` for all hosts.
    pub(super) fn observe(&mut self, asks: bool) -> BTreeMap<String, Result<Vec<NodeSeen>, HostError>> {
        thread::scope(|scope| {
            let sessions = self.sessions.iter_mut();
            let observing: Vec<_> = sessions
                .map(|(host, session)| (host.clone(), scope.spawn(move || session.observe(asks))))
                .collect();
            let seen = observing
                .into_iter()
                .map(|(host, thread)| (host, thread.join().expect("a session does not panic")));
            seen.collect()
        })
    }

    /// Does a request on a host, and returns the host's note.
    pub(super) fn order(&mut self, host: &str, request: &Request) -> Result<String, HostError> {
        self.session(host)?.order(request)
    }

    /// Removes the leftovers of a start that changed nothing from all hosts: its lock, and files that it sent.
    pub(super) fn sweep(&mut self) {
        for session in self.sessions.values_mut() {
            // The cause of the failed start is reported, and the next one sweeps again.
            let _ = session.order(&Request::Sweep);
        }
    }

    /// Sends the contents that a host lacks for these orders.
    pub(super) fn send<'o>(
        &mut self,
        host: &str,
        orders: impl Iterator<Item = &'o NodeOrder>,
        contents: &BTreeMap<Hash, PathBuf>,
    ) -> Result<Sent, HostError> {
        let session = self.session(host)?;
        let mut hashes: Vec<Hash> = orders.flat_map(NodeOrder::hashes).cloned().collect();
        hashes.sort();
        hashes.dedup();
        let answer = session.ask(&Request::Missing(hashes))?;
        let Answer::Missing(missing) = answer else { return Err(session.unfit(&answer)) };
        let mut sent = Sent::default();
        for hash in missing {
            let Some(path) = contents.get(&hash) else { continue };
            sent.bytes += session.put(&hash, path)?;
            sent.files += 1;
        }
        Ok(sent)
    }

    fn session(&mut self, host: &str) -> Result<&mut Session, HostError> {
        let lost =
            || HostError::Unreachable { host: host.to_owned(), why: "there is no connection".to_owned() };
        self.sessions.get_mut(host).ok_or_else(lost)
    }
}

/// Returns the observed nodes of all hosts, for a plan.
pub(super) fn observed(seen: &BTreeMap<String, Vec<NodeSeen>>) -> Vec<Observed> {
    let of = |(host, node): (&String, &NodeSeen)| Observed {
        host: host.clone(),
        order: node.order.clone(),
        is_running: node.process.is_some(),
    };
    seen.iter().flat_map(|(host, nodes)| nodes.iter().map(move |node| (host, node))).map(of).collect()
}
