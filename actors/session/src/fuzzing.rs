//! Fuzzing of the session: a script of frames between two nodes for both halves of a live session: whole,
//! damaged, old, invented.

use std::collections::VecDeque;

use bytes::BytesMut;
use sinew_runtime::{
    fuzzing::Script,
    tid::Tid,
    wire::{FrameCodec, Header, Kind, Message, decode, encode_frame},
};
use tokio_util::codec::Decoder as _;

use super::{Ack, AckEffect, Arrival, Receiving, Sending, Window};

/// Both ends send an ACK, two messages are sent, one is acknowledged, the connection ends and is established
/// again.
pub const A_SESSION: &[u8] = &[0, 1, 0, 1, 2, 2, 3, 1, 4, 5, 0, 1, 3, 1];

const WINDOW: Window = Window { messages: 8, bytes: 1_000 };
const PAYLOAD_MAX: usize = 4_096;

/// Plays a script. Returns whether any message has arrived in it.
pub fn session(script: &[u8]) -> bool {
    let mut play = Play {
        script: Script::new(script),
        sending: Sending::new(1, WINDOW),
        receiving: Receiving::new(1),
        codec: FrameCodec::new(PAYLOAD_MAX),
        incoming: BytesMut::new(),
        wire: VecDeque::new(),
        link: 0,
        next: 0,
        taken: 0,
        arrived: 0,
        is_honest: true,
    };
    while !play.script.is_over() {
        play.step();
        play.check();
    }
    play.arrived > 0
}

struct Play<'a> {
    script: Script<'a>,
    sending: Sending<u32>,
    receiving: Receiving,
    codec: FrameCodec,
    incoming: BytesMut,
    /// Messages in flight from the sending half to the receiving one, by number.
    wire: VecDeque<(u64, Option<u32>)>,
    link: u64,
    /// The next message to send.
    next: u32,
    /// The last received message of a correct peer.
    taken: u32,
    arrived: u64,
    /// Whether both ends have kept the rules so far. Then no message arrives twice or out of order.
    is_honest: bool,
}

impl Play<'_> {
    fn step(&mut self) {
        match self.script.byte() % 10 {
            // A new connection: both ends send the next number that they expect.
            0 => {
                self.link += 1;
                self.wire.clear();
                self.incoming.clear();
                self.sending.link_ended();
                self.receiving.attach(self.link);
                let epoch = self.sending.epoch();
                self.receiving.on_epoch(self.link, epoch);
            }
            // Before the first connection no frame is sent.
            1 if self.link == 0 => {}
            1 => {
                let ack = self.receiving.ack(1, None);
                self.on_ack(&ack);
            }
            2 => self.send(),
            3 => self.carry(),
            4 => {
                self.wire.pop_back();
                // A loss on a connection ends it.
                self.wire.clear();
                self.sending.link_ended();
            }
            5 => {
                self.sending.void(|message| message % 2 == 0);
            }
            6 => {
                self.is_honest = false;
                let ack = self.scripted_ack();
                self.by_frame(&ack);
            }
            7 => {
                self.is_honest = false;
                let (link, number, bytes) =
                    (self.script.number(), self.script.byte(), usize::from(self.script.byte()));
                let arrival = self.receiving.arrive(link, number.into(), bytes);
                self.arrived += u64::from(matches!(arrival, Arrival::Take { .. }));
            }
            8 => {
                self.is_honest = false;
                let count = usize::from(self.script.byte());
                let bytes = self.script.bytes(count);
                if let Ok(ack) = decode::<Ack>(bytes) {
                    self.on_ack(&ack);
                }
            }
            _ => {
                let (link, epoch) = (self.script.number(), self.script.number());
                self.is_honest = false;
                if self.script.byte() & 1 == 0 {
                    self.receiving.attach(link);
                }
                self.receiving.on_epoch(link, epoch);
                let room = Window { messages: self.script.byte().into(), bytes: self.script.byte().into() };
                self.receiving.must_announce_room(room);
                self.receiving.ack(epoch, Some(room));
            }
        }
    }

    /// Sends the next message in GNCL's order: retransmissions first, then new messages.
    fn send(&mut self) {
        if let Some((number, message)) = self.sending.again() {
            self.wire.push_back((number, message.copied()));
        } else if self.sending.has_room() {
            self.next = self.next.wrapping_add(1);
            let number = self.sending.keep(self.next, 1 + self.next as usize % 400);
            self.wire.push_back((number, Some(self.next)));
        }
    }

    fn carry(&mut self) {
        let Some((number, message)) = self.wire.pop_front() else { return };
        let arrival = self.receiving.arrive(self.link, number as u16, 10);
        if let (Arrival::Take { .. }, Some(message)) = (arrival, message) {
            self.arrived += 1;
            if self.is_honest {
                assert!(message > self.taken, "{message} came after {}", self.taken);
                self.taken = message;
            }
        }
        if self.is_honest {
            assert!(!matches!(arrival, Arrival::OutOfStep { .. }), "{arrival:?} of {number}");
        }
    }

    fn on_ack(&mut self, ack: &Ack) {
        if let AckEffect::Reset(lost) = self.sending.on_ack(ack) {
            assert!(!self.is_honest || lost.is_empty(), "an honest peer has forgotten {lost:?}");
            // The peer is notified of the new epoch before all else, on this connection.
            self.wire.clear();
            self.receiving.on_epoch(self.link, self.sending.epoch());
            self.sending.epoch_announced(self.sending.epoch());
        }
    }

    fn scripted_ack(&mut self) -> Ack {
        let [receiver_id, epoch, peer_epoch, next] = [(); 4].map(|()| self.script.number());
        let room = [(); 2].map(|()| self.script.number());
        Ack {
            receiver_id,
            epoch,
            peer_epoch,
            next,
            change: next,
            held: vec![room[0]; 2],
            room: (receiver_id & 1 == 1).then_some(room.into()),
        }
    }

    /// Sends the ACK through the frame codec, with one byte changed or none.
    fn by_frame(&mut self, ack: &Ack) {
        let payload = rmp_serde::to_vec_named(ack).expect("numbers can be written");
        let before = self.incoming.len();
        encode_frame(&Header::new(Kind::GNCL_ACK, Tid::NONE, Tid::NONE), &payload, &mut self.incoming);
        let (at, flipped) = (usize::from(self.script.byte()), self.script.byte());
        if let Some(byte) = self.incoming.get_mut(before + at) {
            *byte ^= flipped;
        }
        loop {
            match self.codec.decode(&mut self.incoming) {
                Ok(Some(Message { payload, .. })) => {
                    if let Ok(ack) = decode::<Ack>(&payload) {
                        self.on_ack(&ack);
                    }
                }
                Ok(None) => return,
                Err(_) => {
                    // The connection cannot be used after it.
                    self.incoming.clear();
                    self.codec = FrameCodec::new(PAYLOAD_MAX);
                    return self.sending.link_ended();
                }
            }
        }
    }

    fn check(&self) {
        let sent = self.sending.position();
        assert!(self.sending.kept() <= WINDOW.messages, "{} kept", self.sending.kept());
        assert!(self.sending.kept_without_voids() <= self.sending.kept());
        assert!(sent.acknowledged <= sent.next, "{sent:?}");
        assert!(self.sending.behind() <= self.sending.kept());
        if self.sending.is_through() {
            assert_eq!(self.sending.behind(), 0);
        }
    }
}
