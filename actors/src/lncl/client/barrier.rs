//! A client that waits until all that it requires is ready.

use std::{cell::Cell, future::pending, sync::TryLockError, time::Duration};

use bytes::BytesMut;
use sinew_runtime::{tid::AppAddress, wire::Kind};

use super::{
    super::{
        payload::{self, Missing, Waiting},
        reader::Reader,
        session::{Order, Session},
    },
    Client, encoded,
    end::End,
    write_some, write_soon,
};
use crate::stores::Stores;

/// Time between two looks at what a client waits for.
const LOOK: Duration = Duration::from_secs(1);
/// The same while nothing is known of it.
const FIRST_LOOK: Duration = Duration::from_millis(100);
/// Bytes of names and reasons that it is told at most: even the smallest socket that is empty takes the frame whole.
const TOLD_BYTES_MAX: usize = 1_536;

impl Client {
    /// Holds the client until all that it requires is ready. Returns why its connection ended, if it did.
    pub(super) async fn wait_at_barrier(&self, reader: &mut Reader, session: &mut Session) -> Option<End> {
        // spec: LNCL-6
        if self.requires.is_empty() {
            return None;
        }
        // The release comes through this very thread, so that it cannot come before somebody waits for it.
        let released = self.server.wait_for_release(self.tid.app);
        let early = async {
            match reader.next(&self.peer.stream).await {
                Ok(Some(message)) => match session.handle(message) {
                    Order::Unregister => End::Unregistered,
                    Order::End(violation) => End::Refused(violation.to_string()),
                    Order::Register(_)
                    | Order::Route(_)
                    | Order::Settle { .. }
                    | Order::SetMember { .. }
                    | Order::Tell { .. }
                    | Order::Resolve { .. }
                    | Order::Introduce { .. }
                    | Order::Switch { .. }
                    | Order::RefuseMessage { .. } => End::Refused("wait for LNCL_REGISTERED".to_owned()),
                },
                Ok(None) => End::HungUp(None),
                Err(error) => End::from(error),
            }
        };
        let unsaid = Cell::default();
        let end = tokio::select! {
            end = early => Some(end),
            end = self.say_what_is_missing(&unsaid) => Some(end),
            released = released => released.is_err().then(|| End::Refused("LNCL ended".to_owned())),
        };
        self.server.forget_release(self.tid.app);
        if end.is_some() {
            return end;
        }
        // What it was told in part comes before anything else.
        write_soon(&self.peer.stream, unsaid.into_inner()).await.err()
    }

    /// Says what the client waits for whenever that is something else, if it wants to know. Ends with the connection.
    async fn say_what_is_missing(&self, unsaid: &Cell<BytesMut>) -> End {
        if !self.waits {
            return pending().await;
        }
        let mut told = None;
        loop {
            let mut bytes = unsaid.take();
            // Who does not read what it is told is told later.
            if bytes.is_empty()
                && let Some(waiting) = missing(&self.server.stores, self.tid.app)
                && told.as_ref() != Some(&waiting)
            {
                let lncl = payload::lncl_of(self.tid.node);
                bytes = encoded(&payload::frame(Kind::LNCL_WAITING, lncl, self.tid, &waiting));
                told = Some(waiting);
            }
            let wrote = write_some(&self.peer.stream, &mut bytes);
            unsaid.set(bytes);
            if let Err(end) = wrote {
                return end;
            }
            let is_known = told.as_ref().is_some_and(|told: &Waiting| !told.missing.is_empty());
            tokio::time::sleep(if is_known { LOOK } else { FIRST_LOOK }).await;
        }
    }
}

/// What `app` waits for; nothing if the sync manager has not heard of it yet. `None`: the sync manager is at work, and this thread
/// does not wait for it.
fn missing(stores: &Stores, app: AppAddress) -> Option<Waiting> {
    let missing = match stores.sync.try_lock() {
        Ok(sync) => sync.missing_in_brief(app),
        Err(TryLockError::Poisoned(sync)) => sync.into_inner().missing_in_brief(app),
        Err(TryLockError::WouldBlock) => return None,
    };
    let mut left = TOLD_BYTES_MAX;
    let missing = missing.into_iter().map(|(what, why)| Missing { what, why: why.to_owned() });
    let missing = missing.take_while(|missing| {
        let bytes = missing.what.len() + missing.why.len();
        left.checked_sub(bytes).inspect(|rest| left = *rest).is_some()
    });
    Some(Waiting { missing: missing.collect() })
}
