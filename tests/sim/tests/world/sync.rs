//! The adapter of the sync manager: it does the work of its actor for the core's outputs.

use sinew_model::{
    barrier::{ArriveAtBarrier, LeaveBarrier},
    events::SyncEvent,
    facts::AppFact,
};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Header, Kind, Message, Payload},
};
use sinew_sync::{Input, Output};

use crate::{Fault, plan::Layer, world::World};

impl World {
    /// Handles an event of the queue. `unread` events are behind it.
    pub(crate) fn take_sync_event(&mut self, process: usize, event: SyncEvent) {
        self.processes[process].sync_events += 1;
        self.processes[process].sync_inputs = 0;
        match event {
            SyncEvent::App(fact) => self.sync(process, Input::AppChanged(fact)),
            SyncEvent::Membership(fact) => {
                let words = self.judge.sync_was_told(process, &fact);
                self.judge.violations.extend(words);
                self.sync(process, Input::MembershipChanged(fact));
            }
            SyncEvent::Link(fact) => {
                let words = self.judge.sync_was_told_of_a_link(process, &fact);
                self.judge.violations.extend(words);
                self.sync(process, Input::LinkChanged(fact));
            }
            SyncEvent::Monitors => {}
            SyncEvent::Message(message) => self.take_message(process, message),
        }
    }

    fn take_message(&mut self, process: usize, message: Message) {
        let Tid { node, app } = message.header.source;
        let correlation = message.header.correlation;
        let payload = message.payload.clone();
        let input = match message.header.kind {
            ArriveAtBarrier::KIND => {
                let asked = message.decode().expect("a played application has sent it");
                Input::Arrived { app, correlation, asked }
            }
            LeaveBarrier::KIND => {
                let LeaveBarrier { barrier, correlation } = message.decode().expect("as above");
                Input::Left { app, barrier, correlation }
            }
            Kind::SYNC_ARRIVALS => Input::ArrivalsReceived { from: node, payload },
            _ => Input::ListReceived { from: node, payload },
        };
        if node != self.processes[process].address {
            let Header { kind, sequence, number, .. } = message.header;
            self.note(process, || format!("takes frame {sequence} ({number}) of {node}, of kind {kind}"));
            let words = self.judge.frame_of_a_node(process, &message.header);
            self.judge.violations.extend(words);
        }
        self.sync(process, input);
    }

    pub(crate) fn sync(&mut self, process: usize, input: Input) {
        // The sync manager of a leaving node has ended, see `leave`.
        if self.processes[process].is_leaving {
            return;
        }
        let now = self.local(process);
        let p = &mut self.processes[process];
        let unread = p.event_queues.sync.len();
        p.sync.woken(now, unread);
        if matches!(input, Input::TimePassed | Input::RoomMade) {
            p.sync.handle(now, input);
        } else {
            p.sync_inputs += 1;
            p.sync.handle_once(now, (p.sync_events, p.sync_inputs), input);
        }
        self.execute_sync(process);
    }

    fn execute_sync(&mut self, process: usize) {
        while let Some(output) = self.processes[process].sync.poll() {
            self.execute_sync_output(process, output);
        }
        self.set_timer(process, Layer::Sync);
    }

    fn execute_sync_output(&mut self, process: usize, output: Output) {
        match output {
            Output::Release { app } => self.release(process, app),
            Output::Notify { app, event, .. } => self.requirement_changed(process, app, &event),
            Output::Publish { to, list } => {
                let key = (process, to);
                let is_repeated = self.fault == Some(Fault::ListNotRepeated)
                    && self.last_lists.get(&key).is_some_and(|last| *last == list);
                if is_repeated {
                    return;
                }
                self.last_lists.insert(key, list.clone());
                if !self.send_to_sync(process, to, Kind::SYNC_DIRECTORY, list) {
                    let now = self.local(process);
                    self.processes[process].sync.handle(now, Input::ListRejected { to });
                }
            }
            Output::PublishArrivals { to, frame } => {
                if !self.send_to_sync(process, to, Kind::SYNC_ARRIVALS, frame) {
                    let now = self.local(process);
                    self.processes[process].sync.handle(now, Input::ArrivalsRejected { to });
                }
            }
            Output::AnswerBarrier { app, correlation, answer } => {
                self.barrier_answered(process, app, correlation, &answer);
            }
            Output::Refused { cause, detail } => {
                self.judge.violate(format!("process {process} refuses because of {cause}: {detail}"));
            }
            Output::NotifyDirectory { .. }
            | Output::RouteGroups { .. }
            | Output::Cycle { .. }
            | Output::Overdue(_)
            | Output::Misspelt { .. }
            | Output::SameName { .. } => {}
        }
    }

    fn send_to_sync(&mut self, process: usize, to: NodeAddress, kind: Kind, payload: bytes::Bytes) -> bool {
        let now = self.local(process);
        let p = &mut self.processes[process];
        let mut header =
            Header::new(kind, Tid::new(p.address, AppAddress::SYNC), Tid::new(to, AppAddress::SYNC));
        header.sequence = p.sync.next_sequence();
        // For the judge: a sync manager ignores it.
        header.correlation = p.incarnation.0;
        header.sent = now;
        self.submit(process, to, (header, payload))
    }

    /// Replaces this layer's instance: the core stays.
    pub(crate) fn restart_sync(&mut self, process: usize) {
        let now = self.local(process);
        self.processes[process].sync.replaced(now);
        self.sync(process, Input::RoomMade);
    }

    pub(crate) fn app_changed(&mut self, process: usize, fact: AppFact) {
        self.note(process, || format!("{fact:?}"));
        self.post_sync(process, SyncEvent::App(fact));
    }
}
