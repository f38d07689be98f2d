//! Keeps what the core remembers of this node's peers in a file, if the configuration has a place for it. Files are read and written by
//! threads made for that: a disk may hang, and NDL's thread waits for nobody.

use std::{rc::Rc, sync::Arc, thread, time::Duration};

use tokio::sync::oneshot;

use super::{Shell, lock};
use crate::{
    ndl::{
        core::Input,
        peers_file::{Kept, PeersFile},
    },
    nicer::give_way,
    stores::{self, Stores},
};

/// Time between two looks whether there is something to write: so often at most the file is written, and so much a lost supply takes.
const LOOK_GAP: Duration = Duration::from_secs(1);
/// Time until what could not be written is tried again.
const RETRY: Duration = Duration::from_secs(60);
/// Time after which it is said that a file takes long.
const SLOW: Duration = Duration::from_secs(10);

/// Takes in what earlier lives remembered, then keeps what this one does, for as long as this instance is the current one.
pub(super) async fn keep(shell: Rc<Shell>) {
    let Some(directory) = &shell.stores.config.state else { return };
    let file = PeersFile::of(directory, shell.stores.node);
    if !lock(&shell.stores).has_recalled() {
        let peers = read(&file).await.peers;
        if !shell.feed(|core, now| core.handle(now, Input::PeersRemembered(peers))) {
            return;
        }
    }
    let (mut written, mut has_failed) = (0, false);
    loop {
        tokio::time::sleep(if has_failed { RETRY } else { LOOK_GAP }).await;
        let (changes, is_current) = {
            let core = lock(&shell.stores);
            (core.memory_changes(), core.is_current(shell.epoch))
        };
        if !is_current {
            return;
        }
        if changes == written {
            continue;
        }
        match write(&file, &shell.stores).await {
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

async fn read(file: &PeersFile) -> Kept {
    let (path, reads) = (file.path().display(), file.clone());
    let kept = elsewhere(file, "read", move || reads.read()).await.unwrap_or_else(|why| {
        crate::log::warn!(%path, "NDL does not know where its peers were: {why}. They are found by the other sources alone");
        Kept::default()
    });
    if let Some((count, first)) = kept.unreadable {
        crate::log::warn!(
            %path, count, first,
            "NDL leaves out lines of this file that are no peers, from line {first} on; delete the file, or those lines: the next change replaces it"
        );
    }
    kept
}

async fn write(file: &PeersFile, stores: &Arc<Stores>) -> Result<(), String> {
    let (writes, stores) = (file.clone(), stores.clone());
    let write = move || {
        // A thread of a former instance may have waited for the disk: whoever writes last writes what is so then.
        let _turn = stores::lock(&stores.ndl_file);
        let peers = lock(&stores).remembered();
        writes.write(&peers)
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
    begun.map_err(|error| format!("there is no thread for it: {error}; raise `ulimit -u`"))?;
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
