//! A script of frames between two nodes, played to both halves of a live session: whole, damaged, old, made up.

use std::collections::VecDeque;

use bytes::BytesMut;
use sinew_runtime::{
    tid::Tid,
    wire::{FrameCodec, Header, Kind, Message, decode, encode_frame},
};
use tokio_util::codec::Decoder as _;

use super::{Ack, Arrival, Heard, Receiving, Sending, Window};
use crate::fuzzing::Script;

/// Both ends say what they take, two messages go, one is acknowledged, the connection ends and is made again.
pub(crate) const A_SESSION: &[u8] = &[0, 1, 0, 1, 2, 2, 3, 1, 4, 5, 0, 1, 3, 1];

const WINDOW: Window = Window { messages: 8, bytes: 1_000 };
const PAYLOAD_MAX: usize = 4_096;

/// Plays a script. Returns whether any message has come in it.
pub(crate) fn session(script: &[u8]) -> bool {
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
        came: 0,
        is_honest: true,
    };
    while !play.script.is_over() {
        play.step();
        play.check();
    }
    play.came > 0
}

struct Play<'a> {
    script: Script<'a>,
    sending: Sending<u32>,
    receiving: Receiving,
    codec: FrameCodec,
    incoming: BytesMut,
    /// Messages on their way from the sending half to the receiving one, by number.
    wire: VecDeque<(u64, Option<u32>)>,
    link: u64,
    /// What is sent next.
    next: u32,
    /// The last that came, of an honest peer's.
    taken: u32,
    came: u64,
    /// Both ends have kept the rules so far: then nothing comes twice, or out of order.
    is_honest: bool,
}

impl Play<'_> {
    fn step(&mut self) {
        match self.script.byte() % 10 {
            // A new connection: both ends say where they go on.
            0 => {
                self.link += 1;
                self.wire.clear();
                self.incoming.clear();
                self.sending.link_ended();
                self.receiving.attach(self.link);
                let epoch = self.sending.epoch();
                self.receiving.heard(self.link, epoch);
            }
            // Before the first connection nobody says anything.
            1 if self.link == 0 => {}
            1 => {
                let ack = self.receiving.ack(1, None);
                self.hear(&ack);
            }
            2 => self.send(),
            3 => self.carry(),
            4 => {
                self.wire.pop_back();
                // What is lost on a connection ends it.
                self.wire.clear();
                self.sending.link_ended();
            }
            5 => {
                self.sending.void(|message| message % 2 == 0);
            }
            6 => {
                self.is_honest = false;
                let ack = self.made_up();
                self.by_frame(&ack);
            }
            7 => {
                self.is_honest = false;
                let (link, number, bytes) =
                    (self.script.number(), self.script.byte(), usize::from(self.script.byte()));
                let arrival = self.receiving.arrive(link, number.into(), bytes);
                self.came += u64::from(matches!(arrival, Arrival::Take { .. }));
            }
            8 => {
                self.is_honest = false;
                let count = usize::from(self.script.byte());
                let bytes = self.script.bytes(count);
                if let Ok(ack) = decode::<Ack>(bytes) {
                    self.hear(&ack);
                }
            }
            _ => {
                let (link, epoch) = (self.script.number(), self.script.number());
                self.is_honest = false;
                if self.script.byte() & 1 == 0 {
                    self.receiving.attach(link);
                }
                self.receiving.heard(link, epoch);
                let room = Window { messages: self.script.byte().into(), bytes: self.script.byte().into() };
                self.receiving.owes_room(room);
                self.receiving.ack(epoch, Some(room));
            }
        }
    }

    /// As GNCL does: what is behind first, then what is new.
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
            self.came += 1;
            if self.is_honest {
                assert!(message > self.taken, "{message} came after {}", self.taken);
                self.taken = message;
            }
        }
        if self.is_honest {
            assert!(!matches!(arrival, Arrival::OutOfStep { .. }), "{arrival:?} of {number}");
        }
    }

    fn hear(&mut self, ack: &Ack) {
        if let Heard::Reset(lost) = self.sending.heard(ack) {
            assert!(!self.is_honest || lost.is_empty(), "an honest peer has forgotten {lost:?}");
            // The peer is told of the new epoch before all else, on this connection.
            self.wire.clear();
            self.receiving.heard(self.link, self.sending.epoch());
            self.sending.told(self.sending.epoch());
        }
    }

    fn made_up(&mut self) -> Ack {
        let [memory, epoch, of, next] = [(); 4].map(|()| self.script.number());
        let room = [(); 2].map(|()| self.script.number());
        Ack {
            memory,
            epoch,
            of,
            next,
            change: next,
            held: vec![room[0]; 2],
            room: (memory & 1 == 1).then_some(room.into()),
        }
    }

    /// On the way of all frames, with one byte changed on it or none.
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
                        self.hear(&ack);
                    }
                }
                Ok(None) => return,
                Err(_) => {
                    // The connection is of no use after it.
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
        assert!(self.sending.kept_with_a_use() <= self.sending.kept());
        assert!(sent.acknowledged <= sent.next, "{sent:?}");
        assert!(self.sending.behind() <= self.sending.kept());
        if self.sending.is_through() {
            assert_eq!(self.sending.behind(), 0);
        }
    }
}
