//! The stop of a node at its routing table: the latch of its outputs, and the echoes that are cut while it is stopped.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, atomic::Ordering},
};

use super::Router;
use crate::{
    protection::{StopLatch, raw::ECHO},
    tid::{AppAddress, NodeAddress},
    wire::Header,
};

/// Maximum number of applications in other processes that have acknowledged a stop. Beyond it all have to do so again.
const ACKNOWLEDGED_MAX: usize = 4_096;

/// The applications of which echoes are handed over after a stop.
#[derive(Clone, Debug, Default)]
pub(super) struct EchoSources {
    /// Those with outputs in this process, which read the latch themselves.
    here: BTreeSet<AppAddress>,
    /// Those in other processes, by the number of presses that they have acknowledged.
    acknowledged: BTreeMap<AppAddress, u64>,
}

impl Router {
    /// Returns the latch that the outputs of this node's applications obey.
    #[must_use]
    pub const fn stop(&self) -> &Arc<StopLatch> {
        &self.stop
    }

    /// Has each output that an application of this process makes from now on measured by a dry run: its safe function
    /// is called once more, before the output is armed.
    pub fn run_dry(&self) {
        self.runs_dry.store(true, Ordering::Relaxed);
    }

    /// Returns whether outputs are measured by a dry run.
    pub(crate) fn runs_dry(&self) -> bool {
        self.runs_dry.load(Ordering::Relaxed)
    }

    /// Stops the outputs of this process at once, if the node is in this process.
    pub(crate) fn press_stop(&self) {
        // Elsewhere nothing would release them: the node does it.
        if self.uplink.is_none() {
            self.stop.press();
        }
    }

    /// Returns the nodes to which there is a route.
    #[must_use]
    pub fn linked(&self) -> Vec<NodeAddress> {
        self.snapshot.load().table.peers.keys().copied().collect()
    }

    /// Adds an application with an output in this process, which reads the latch itself.
    pub(crate) fn add_guarded_here(&self, app: AppAddress) {
        if !self.echo_sources.load().here.contains(&app) {
            self.echo_sources.rcu(|sources| {
                let mut sources = EchoSources::clone(sources);
                sources.here.insert(app);
                sources
            });
        }
    }

    /// Acknowledges the stop that is released, for an application in another process. Returns `false` while a stop is
    /// in force.
    pub fn acknowledge_stop(&self, app: AppAddress) -> bool {
        let now = self.stop.read();
        if now.is_stopped() {
            return false;
        }
        self.echo_sources.rcu(|sources| {
            let mut sources = EchoSources::clone(sources);
            if sources.acknowledged.len() >= ACKNOWLEDGED_MAX {
                sources.acknowledged.clear();
            }
            sources.acknowledged.insert(app, now.presses());
            sources
        });
        true
    }

    /// Returns whether the message is an echo that a stop cuts: every one while the node is stopped, and later those of
    /// applications in other processes that have not acknowledged the stop. In the hold at the node's start it cuts the
    /// ones of all applications in other processes. Without echoes the commands of every sender
    /// become too old, also for outputs that do not read the latch.
    #[inline]
    pub(super) fn is_cut(&self, header: &Header) -> bool {
        header.kind == ECHO && self.is_echo_cut(header)
    }

    fn is_echo_cut(&self, header: &Header) -> bool {
        let (now, source) = (self.stop.read(), header.source);
        let is_free = now.presses() == 0 && !now.is_starting();
        if now.is_stopped() || is_free || source.node != self.node || self.uplink.is_some() {
            return now.is_stopped();
        }
        let sources = self.echo_sources.load();
        let has_acknowledged =
            !now.is_starting() && sources.acknowledged.get(&source.app) == Some(&now.presses());
        !sources.here.contains(&source.app) && !has_acknowledged
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::{
        outcome::Rejection,
        router::{LocalRoute, MessageSink, SubmitError},
        tid::{AppAddress, Tid},
        wire::{Kind, Message},
    };

    struct Sink;

    impl MessageSink for Sink {
        fn submit(&self, _: Message) -> Result<(), SubmitError> {
            Ok(())
        }
    }

    #[test]
    fn stopped_node_hands_over_no_echo() {
        let (here, app) = (NodeAddress::new(7), AppAddress::new(0x1001));
        let router = Router::new(here);
        router.set_local(app, LocalRoute { sink: Arc::new(Sink), events: Arc::new([]) });
        let message = |kind| Message::new(Header::new(kind, Tid::NONE, Tid::new(here, app)), Bytes::new());
        let both = |kind| (router.send(message(kind)), router.deliver(message(kind)));
        let other = Kind::named("test.other");
        assert_eq!((both(ECHO), both(other)), ((Ok(()), Ok(())), (Ok(()), Ok(()))));
        router.press_stop();
        let cut = Err(Rejection::NotAllowed);
        assert_eq!((both(ECHO), both(other)), ((cut, cut), (Ok(()), Ok(()))));
        assert!(router.offer(message(ECHO), None).is_err());
        assert!(router.stop().release(router.stop().read()));
        assert_eq!(both(ECHO), (Ok(()), Ok(())), "the hold cuts nothing");
    }

    #[test]
    fn application_in_another_process_acknowledges_each_stop() {
        let (here, app) = (NodeAddress::new(7), AppAddress::new(0x1001));
        let router = Router::new(here);
        router.set_local(app, LocalRoute { sink: Arc::new(Sink), events: Arc::new([]) });
        let [own, other] = [0x1002, 0x8000_0001].map(AppAddress::new);
        router.add_guarded_here(own);
        let echo_of = |of| {
            let header = Header::new(ECHO, Tid::new(here, of), Tid::new(here, app));
            router.send(Message::new(header, Bytes::new())).is_ok()
        };
        assert!(echo_of(own) && echo_of(other));
        router.stop().begin();
        assert!(echo_of(own) && !echo_of(other), "a node that starts does not know of a stop yet");
        router.stop().hold(false);
        router.stop().hold(true);
        assert!(echo_of(own) && echo_of(other), "outputs that are live stay so in a later hold");
        for _ in 0..2 {
            router.press_stop();
            assert!(!echo_of(own) && !echo_of(other) && !router.acknowledge_stop(other));
            assert!(router.stop().release(router.stop().read()));
            assert!(echo_of(own) && !echo_of(other));
            assert!(router.acknowledge_stop(other) && echo_of(other));
        }
    }

    #[test]
    fn process_without_the_node_presses_nothing_itself() {
        let router = Router::through(NodeAddress::new(7), Arc::new(Sink));
        router.press_stop();
        assert!(!router.stop().read().is_stopped());
    }
}
