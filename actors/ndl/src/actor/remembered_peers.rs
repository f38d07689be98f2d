//! Keeps the core's remembered peers in a file, if the configuration has a state directory. Separate threads
//! read and write the file: a disk may hang, and NDL's thread never blocks.

use std::{rc::Rc, sync::Arc, thread, time::Duration};

use sinew_model::thread_priority::lower_priority;
use sinew_runtime::{
    lock,
    remedy::{Wanted, remedy},
};
use tokio::sync::oneshot;

use super::{Shell, lock_core};
use crate::{
    State,
    core::{Input, RememberedPeer},
    peers_file::{Kept, PeersFile},
};

/// Time from a change to its write, or from one write to the next one. It is the maximum loss in a power failure.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// Retry interval after a failed write, and the maximum one after a failed read.
const RETRY: Duration = Duration::from_secs(60);
/// Time after which a slow file operation is logged.
const SLOW: Duration = Duration::from_secs(10);

/// Loads the peers of earlier incarnations, then saves those of this one, for as long as this instance is the
/// current one.
pub(super) async fn keep(shell: Rc<Shell>) {
    let Some(directory) = &shell.state.ctx.config.state else { return };
    let file = PeersFile::of(directory, &shell.state.ctx.config.project, shell.state.ctx.node);
    if !lock_core(&shell.state).has_loaded_remembered() {
        let Some(peers) = read_with_retries(&file, &shell).await else { return };
        if !shell.feed(|core, now| core.handle(now, Input::PeersRemembered(peers))) {
            return;
        }
    }
    let (mut written, mut has_failed) = (0, false);
    loop {
        if lock_core(&shell.state).remembered_changes() == written {
            shell.remembered_changed.notified().await;
        }
        tokio::time::sleep(if has_failed { RETRY } else { CHECK_INTERVAL }).await;
        let (changes, peers) = {
            // Done here and not in the writing thread: a low-priority thread must not hold up NDL with this lock.
            let core = lock_core(&shell.state);
            if !core.is_current(shell.epoch) {
                return;
            }
            if core.remembered_changes() == written {
                continue;
            }
            (core.remembered_changes(), core.remembered())
        };
        match write(&file, &shell.state, changes, peers).await {
            Ok(()) => (written, has_failed) = (changes, false),
            Err(why) if !has_failed => {
                has_failed = true;
                sinew_runtime::log::warn!(
                    path = %file.path().display(),
                    "NDL cannot save the addresses of its peers: {why}. After a restart they are found by the other sources alone"
                );
            }
            Err(_) => {}
        }
    }
}

/// Returns the content of the file as soon as it can be read, or `None` if a later instance has taken over.
/// Nothing is written before: the peers met since would replace all that the file has.
async fn read_with_retries(file: &PeersFile, shell: &Shell) -> Option<Vec<RememberedPeer>> {
    let (path, mut wait) = (file.path().display(), CHECK_INTERVAL);
    let mut has_failed = false;
    loop {
        let reads = file.clone();
        match on_own_thread(file, "read", move || reads.read()).await {
            Ok(Kept { peers, unreadable }) => {
                if let Some((count, first)) = unreadable {
                    sinew_runtime::log::warn!(
                        %path, count, first,
                        "NDL ignores lines of this file that are no peers, from line {first} on; delete the file, or those lines: the next change replaces it"
                    );
                }
                return Some(peers);
            }
            Err(why) if !has_failed => {
                has_failed = true;
                sinew_runtime::log::warn!(
                    %path,
                    "NDL does not know the former addresses of its peers: {why}. They are found by the other sources alone, and nothing is written, until \
                     the file can be read or is deleted; NDL retries every {RETRY:?} or sooner"
                );
            }
            Err(_) => {}
        }
        tokio::time::sleep(wait).await;
        wait = RETRY.min(wait * 2);
        if !lock_core(&shell.state).is_current(shell.epoch) {
            return None;
        }
    }
}

/// Writes the peers as of this number of changes.
async fn write(
    file: &PeersFile,
    state: &Arc<State>,
    changes: u64,
    peers: Vec<RememberedPeer>,
) -> Result<(), String> {
    let (writes, state) = (file.clone(), state.clone());
    let write = move || {
        // The thread of a former instance may have been blocked by the disk. Its state is then older than the file's.
        let mut written = lock(&state.file);
        if *written < changes {
            writes.write(&peers)?;
            *written = changes;
        }
        Ok(())
    };
    on_own_thread(file, "written", write).await
}

/// Runs `act` on its own thread. A disk that hangs blocks only this thread, and the delay is logged.
async fn on_own_thread<T: Send + 'static>(
    file: &PeersFile,
    done: &str,
    act: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, String> {
    let (sender, mut receiver) = oneshot::channel();
    let begun = thread::Builder::new().name("ndl-peers".to_owned()).spawn(move || {
        lower_priority();
        // The receiver is gone if this layer has ended.
        let _ = sender.send(act());
    });
    begun
        .map_err(|error| format!("there is no thread for it: {error}; {}", remedy(Wanted::Thread, &error)))?;
    let ended = || "its thread has panicked".to_owned();
    if let Ok(result) = tokio::time::timeout(SLOW, &mut receiver).await {
        return result.unwrap_or_else(|_| Err(ended()));
    }
    sinew_runtime::log::warn!(
        path = %file.path().display(),
        "the file of NDL's peers is not {done} after {SLOW:?}: check that disk (`dmesg`), or remove `node.state` from the configuration"
    );
    receiver.await.unwrap_or_else(|_| Err(ended()))
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;
    use sinew_model::config::NodeConfig;

    #[test]
    fn file_is_written_without_the_cores_lock() {
        // given
        let directory = std::env::temp_dir().join(format!("sinew-snapshots-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&directory);
        let node = NodeAddress::new(2);
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let file = PeersFile::of(&directory, "sinew", node);
        let peer = |port| RememberedPeer { address: ([10, 0, 0, 7], port).into(), node, unanswered: 0 };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        // when
        let core = lock_core(&state);
        let written = runtime.block_on(async {
            tokio::time::timeout(SLOW, async {
                write(&file, &state, 2, vec![peer(2)]).await?;
                write(&file, &state, 1, vec![peer(1)]).await
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
