//! Keeps what the core remembers of this node's peers in a file, if the configuration has a place for it. Files are read and written by
//! threads made for that: a disk may hang, and NDL's thread waits for nobody.

use std::{rc::Rc, sync::Arc, thread, time::Duration};

use sinew_runtime::remedy::{Wanted, remedy};
use tokio::sync::oneshot;

use super::{Shell, lock};
use crate::{
    ndl::{
        core::{Input, RememberedPeer},
        peers_file::{Kept, PeersFile},
    },
    nicer::give_way,
    stores::{self, Stores},
};

/// Time between two looks whether there is something to write: so often at most the file is written, and so much a lost supply takes.
const LOOK_GAP: Duration = Duration::from_secs(1);
/// Time until what could not be written is tried again, and what could not be read at last.
const RETRY: Duration = Duration::from_secs(60);
/// Time after which it is said that a file takes long.
const SLOW: Duration = Duration::from_secs(10);

/// Takes in what earlier lives remembered, then keeps what this one does, for as long as this instance is the current one.
pub(super) async fn keep(shell: Rc<Shell>) {
    let Some(directory) = &shell.stores.config.state else { return };
    let file = PeersFile::of(directory, &shell.stores.config.project, shell.stores.node);
    if !lock(&shell.stores).has_recalled() {
        let Some(peers) = read_until_read(&file, &shell).await else { return };
        if !shell.feed(|core, now| core.handle(now, Input::PeersRemembered(peers))) {
            return;
        }
    }
    let (mut written, mut has_failed) = (0, false);
    loop {
        tokio::time::sleep(if has_failed { RETRY } else { LOOK_GAP }).await;
        let (changes, peers) = {
            // Here and not by the thread that writes: who gives way must not hold up NDL with this lock.
            let core = lock(&shell.stores);
            if !core.is_current(shell.epoch) {
                return;
            }
            if core.memory_changes() == written {
                continue;
            }
            (core.memory_changes(), core.remembered())
        };
        match write(&file, &shell.stores, changes, peers).await {
            Ok(()) => (written, has_failed) = (changes, false),
            Err(why) if !has_failed => {
                has_failed = true;
                crate::log::warn!(
                    path = %file.path().display(),
                    "NDL cannot keep where its peers are: {why}. After a restart they are found by the other sources alone"
                );
            }
            Err(_) => {}
        }
    }
}

/// What is in the file, as soon as it can be read; nothing when a later instance has taken over. Nothing is written before: who was met
/// since would take the place of all that the file has.
async fn read_until_read(file: &PeersFile, shell: &Shell) -> Option<Vec<RememberedPeer>> {
    let (path, mut wait) = (file.path().display(), LOOK_GAP);
    let mut has_failed = false;
    loop {
        let reads = file.clone();
        match elsewhere(file, "read", move || reads.read()).await {
            Ok(Kept { peers, unreadable }) => {
                if let Some((count, first)) = unreadable {
                    crate::log::warn!(
                        %path, count, first,
                        "NDL leaves out lines of this file that are no peers, from line {first} on; delete the file, or those lines: the next change replaces it"
                    );
                }
                return Some(peers);
            }
            Err(why) if !has_failed => {
                has_failed = true;
                crate::log::warn!(
                    %path,
                    "NDL does not know where its peers were: {why}. They are found by the other sources alone, and nothing is written, until \
                     the file can be read or is gone, which is tried again each {RETRY:?} at least"
                );
            }
            Err(_) => {}
        }
        tokio::time::sleep(wait).await;
        wait = RETRY.min(wait * 2);
        if !lock(&shell.stores).is_current(shell.epoch) {
            return None;
        }
    }
}

/// Writes what was so after this many changes.
async fn write(
    file: &PeersFile,
    stores: &Arc<Stores>,
    changes: u64,
    peers: Vec<RememberedPeer>,
) -> Result<(), String> {
    let (writes, stores) = (file.clone(), stores.clone());
    let write = move || {
        // A thread of a former instance may have waited for the disk: what it has is older than what is there.
        let mut written = stores::lock(&stores.ndl_file);
        if *written < changes {
            writes.write(&peers)?;
            *written = changes;
        }
        Ok(())
    };
    elsewhere(file, "written", write).await
}

/// On a thread of its own. A disk that hangs holds up this alone, which is said.
async fn elsewhere<T: Send + 'static>(
    file: &PeersFile,
    what: &str,
    act: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, String> {
    let (say, mut said) = oneshot::channel();
    let begun = thread::Builder::new().name("ndl-peers".to_owned()).spawn(move || {
        give_way();
        // Nobody waits any more where this layer has ended.
        let _ = say.send(act());
    });
    begun
        .map_err(|error| format!("there is no thread for it: {error}; {}", remedy(Wanted::Thread, &error)))?;
    let ended = || "its thread has panicked".to_owned();
    if let Ok(done) = tokio::time::timeout(SLOW, &mut said).await {
        return done.unwrap_or_else(|_| Err(ended()));
    }
    crate::log::warn!(
        path = %file.path().display(),
        "the file of NDL's peers is not {what} after {SLOW:?}: look at that disk (`dmesg`), or take `node.state` out of the configuration"
    );
    said.await.unwrap_or_else(|_| Err(ended()))
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;
    use crate::config::NodeConfig;

    #[test]
    fn a_file_is_written_without_the_cores_lock_and_never_with_what_is_older_than_what_it_has() {
        // given
        let directory = std::env::temp_dir().join(format!("sinew-snapshots-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&directory);
        let node = NodeAddress::new(2);
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let file = PeersFile::of(&directory, "sinew", node);
        let peer = |port| RememberedPeer { address: ([10, 0, 0, 7], port).into(), node, unanswered: 0 };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        // when
        let core = lock(&stores);
        let written = runtime.block_on(async {
            tokio::time::timeout(SLOW, async {
                write(&file, &stores, 2, vec![peer(2)]).await?;
                write(&file, &stores, 1, vec![peer(1)]).await
            })
            .await
        });
        drop(core);
        // then
        written.expect("waited 10 s for a thread that waits for the core's lock").unwrap();
        assert_eq!(file.read().unwrap().peers, [peer(2)]);
        std::fs::remove_dir_all(&directory).unwrap();
    }
}
