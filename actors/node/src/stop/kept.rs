//! The presses and releases in the state directory: a node that was stopped comes up stopped. spec: STOP-7

use std::{
    path::Path,
    sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    thread,
};

use serde::{Deserialize, Serialize};
use sinew_model::{context::NodeContext, thread_priority::lower_priority};
use sinew_runtime::{
    log,
    remedy::{Wanted, remedy},
    tid::{AppAddress, Tid},
    wire::{decode, encode},
};
use sinew_security::{files, state_files};

use super::{
    core::Stops,
    frame::{ENTRIES_MAX, Entry, Origin},
};

/// Maximum bytes of the file: as many entries as a node keeps, with the longest reasons.
const BYTES_MAX: u64 = 64 * 1024;

/// The content of the file.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Content {
    entries: Vec<Entry>,
}

/// The file, if the node has a state directory, and the thread that writes it.
pub(super) struct Kept {
    changed: Option<SyncSender<Vec<Entry>>>,
    /// The entries that the busy thread could not take yet.
    pending: Option<Vec<Entry>>,
}

impl Kept {
    /// Reads the file, and returns the presses and releases of a former life; `None` if there was none. From then on
    /// there is a file, also before the first press.
    pub(super) fn begin(context: &NodeContext) -> (Self, Option<Stops>) {
        let Some(directory) = &context.config.state else {
            return (Self { changed: None, pending: None }, None);
        };
        let path = state_files::path(directory, "stop", &context.config.project, context.node);
        let stops = read(&path).unwrap_or_else(|why| {
            log::error!(
                ?path,
                "the stop is pressed, as its file cannot be used: {why}; release it (`sinew stop release`), which replaces the file"
            );
            Some(unreadable(context))
        });
        let (notify, changed) = sync_channel(1);
        let writer = path.clone();
        let started =
            thread::Builder::new().name("stop-file".to_owned()).spawn(move || write(&writer, &changed));
        if let Err(error) = &started {
            let remedy = remedy(Wanted::Thread, error);
            log::warn!(
                ?path,
                "a stop does not outlive this node, as there is no thread that writes it: {error}; {remedy}"
            );
        }
        let mut kept = Self { changed: started.is_ok().then_some(notify), pending: None };
        if stops.is_none() {
            kept.keep(&Stops::default());
        }
        (kept, stops)
    }

    /// Has these written. It never waits.
    pub(super) fn keep(&mut self, stops: &Stops) {
        self.pending = Some(stops.entries().cloned().collect());
        self.retry();
    }

    /// Hands over the entries that the thread could not take before. The newest ones are enough.
    pub(super) fn retry(&mut self) {
        let Some(entries) = self.pending.take() else { return };
        if let Some(changed) = &self.changed
            && let Err(TrySendError::Full(entries)) = changed.try_send(entries)
        {
            self.pending = Some(entries);
        }
    }

    /// Returns whether entries wait for the thread.
    pub(super) const fn is_pending(&self) -> bool {
        self.pending.is_some()
    }
}

fn read(path: &Path) -> Result<Option<Stops>, String> {
    let Some(bytes) = files::own(path, BYTES_MAX).map_err(|why| why.to_string())? else { return Ok(None) };
    let Content { mut entries } = decode(&bytes).map_err(|error| error.to_string())?;
    // Other nodes refuse states with such entries: they would not learn of a press.
    if !entries.iter().all(Entry::is_legal) {
        return Err("it has an entry that no node writes".to_owned());
    }
    // The next press of this node is one more entry, and other nodes refuse a longer list. As in a full list, released
    // ones are forgotten first.
    if entries.len() > ENTRIES_MAX {
        entries.retain(Entry::is_open);
    }
    if entries.len() > ENTRIES_MAX {
        return Err(format!("it has more than {ENTRIES_MAX} presses that are not released"));
    }
    Ok(Some(entries.into_iter().collect()))
}

/// Returns the press of a node that does not know whether it was stopped.
fn unreadable(context: &NodeContext) -> Stops {
    let own = Tid::new(context.node, AppAddress::STOP);
    let entry = Entry {
        origin: Origin { node: context.node, incarnation: context.incarnation },
        pressed: 1,
        by: own,
        reason: "the file of the stop in node.state cannot be read".to_owned(),
        released: 0,
        released_by: Tid::NONE,
    };
    std::iter::once(entry).collect()
}

fn write(path: &Path, changed: &Receiver<Vec<Entry>>) {
    lower_priority();
    let mut has_failed = false;
    while let Ok(entries) = changed.recv() {
        let written = state_files::replace(path, &encode(&Content { entries }));
        if let Err(why) = &written
            && !has_failed
        {
            log::warn!(?path, "a stop does not outlive this node: {why}");
        }
        has_failed = written.is_err();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew_model::config::NodeConfig;
    use sinew_runtime::{
        tid::{Incarnation, NodeAddress},
        time::Time,
    };
    use sinew_security::testing::Directory;

    use super::*;

    fn context(directory: &Directory) -> std::sync::Arc<NodeContext> {
        let mut config = NodeConfig::new("knee");
        config.state = Some(directory.path().to_owned());
        NodeContext::for_test(config, Incarnation(1)).0
    }

    // spec: STOP-7
    #[test]
    fn file_that_cannot_be_read_is_a_press() {
        let directory = Directory::new();
        let context = context(&directory);
        let path = state_files::path(directory.path(), "stop", &context.config.project, context.node);
        assert_eq!(Kept::begin(&context).1, None, "there is no file");
        let deadline = Time::now() + Duration::from_secs(60);
        while !path.exists() {
            assert!(Time::now() < deadline, "a life without a press leaves a file, too");
            thread::yield_now();
        }
        assert_eq!(Kept::begin(&context).1, Some(Stops::default()));
        std::fs::write(path, [0xc1]).expect("the test's own directory");
        assert!(Kept::begin(&context).1.is_some_and(|stops| stops.is_open()));
    }

    #[test]
    fn list_that_other_nodes_refuse_is_not_read() {
        let directory = Directory::new();
        let context = context(&directory);
        let path = state_files::path(directory.path(), "stop", &context.config.project, context.node);
        let entry = |node, released| Entry {
            origin: Origin { node: NodeAddress::new(node), incarnation: Incarnation(1) },
            pressed: 1,
            by: Tid::NONE,
            reason: String::new(),
            released,
            released_by: Tid::NONE,
        };
        let read_back = |count: usize, released| {
            let entries = (0..count as u32).map(|node| entry(node, released)).collect();
            state_files::replace(&path, &encode(&Content { entries })).expect("the test's own directory");
            read(&path).map(|stops| stops.map(|stops| stops.entries().count()))
        };
        assert_eq!(read_back(ENTRIES_MAX, 0), Ok(Some(ENTRIES_MAX)));
        assert_eq!(read_back(ENTRIES_MAX + 1, 1), Ok(Some(0)));
        assert!(read_back(ENTRIES_MAX + 1, 0).is_err());
    }

    // spec: STOP-7
    #[test]
    fn written_presses_are_read_by_the_next_life() {
        let directory = Directory::new();
        let context = context(&directory);
        let stops = unreadable(&context);
        let path = state_files::path(directory.path(), "stop", &context.config.project, context.node);
        let (notify, changed) = sync_channel(1);
        notify.send(stops.entries().cloned().collect()).expect("there is room");
        drop(notify);
        write(&path, &changed);
        assert_eq!(Kept::begin(&context).1, Some(stops));
    }
}
