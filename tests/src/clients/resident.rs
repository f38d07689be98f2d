//! Posters that are ordinary applications in the node's own process. They send further confirmed messages
//! while earlier outcomes are pending.

use std::{collections::BTreeMap, time::Duration};

use sinew::prelude::*;

use super::{
    entry::{Entry, Poster, Way},
    poster::{Card, Parcel, Wire, body, is_posting, within},
    print_line,
    registration::address,
};
use sinew_testkit::{DEADLINE, random::SeededRandom};

/// Time between two turns of a poster.
const TURN: Duration = Duration::from_millis(10);
/// Maximum number of pending outcomes.
const WAITS_MAX: usize = 32;

/// The poster `me` of `all`.
pub(super) fn app(me: Poster, all: Poster, seed: u64) -> AppSpec<Resident> {
    let make = move || Resident {
        me,
        all,
        random: SeededRandom::new(seed ^ u64::from(me) << 40),
        numbers: BTreeMap::new(),
        waits: 0,
        is_quiet: false,
    };
    AppSpec::new(format!("poster {me}"), make)
        .address(address(me))
        .handles::<Wire>()
        .handles::<Card>()
        .handles::<Parcel>()
        // The scenario may be slow to read its output.
        .progress_within(DEADLINE)
        .place(Place::thread(format!("posters {}", me % 2)))
}

pub(super) struct Resident {
    me: Poster,
    all: Poster,
    random: SeededRandom,
    numbers: BTreeMap<Way, u64>,
    waits: usize,
    is_quiet: bool,
}

impl Actor for Resident {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.report(&Entry::Up(Time::now()));
        context.every(TURN, |this, _, context| this.take_turn(context));
    }
}

impl Resident {
    fn report(&self, entry: &Entry) {
        print_line(&format!("{} {entry}", self.me));
    }

    fn take_turn(&mut self, context: &mut AppContext<Self>) {
        if is_posting() {
            self.send_one(context);
            for _ in 0..2 {
                self.ask_one(context);
            }
        } else if self.waits == 0 && !self.is_quiet {
            self.is_quiet = true;
            self.report(&Entry::Quiet);
        }
    }

    fn next(&mut self, class: Class, context: &AppContext<Self>) -> (Way, Tid, u64) {
        let other = (self.me + 1 + self.random.below(u32::from(self.all) - 1) as Poster) % self.all;
        let way = Way { to: other, class };
        let number = self.numbers.entry(way).or_default();
        *number += 1;
        (way, Tid::new(context.tid().node, address(other)), *number)
    }

    fn send_one(&mut self, context: &AppContext<Self>) {
        let class = [Class::Control, Class::Stream, Class::Bulk][self.random.below(3) as usize];
        let (way, tid, number) = self.next(class, context);
        let (incarnation, body) = (1, body(&mut self.random, number));
        self.report(&Entry::Sends(way, number, 1, Time::now()));
        let sent = match class {
            Class::Control => context.send(tid, &Wire { incarnation, number, body }),
            Class::Stream => context.send(tid, &Card { incarnation, number, body }),
            Class::Bulk => context.send(tid, &Parcel { incarnation, number, body }),
        };
        if sent.is_err() {
            self.report(&Entry::NotSent(way, number));
        }
    }

    fn ask_one(&mut self, context: &mut AppContext<Self>) {
        if self.waits >= WAITS_MAX {
            return;
        }
        let class = if self.random.once_in(2) { Class::Control } else { Class::Bulk };
        let (way, tid, number) = self.next(class, context);
        let (incarnation, body, within) = (1, body(&mut self.random, number), within(&mut self.random));
        self.report(&Entry::Asks(way, number, Time::now()));
        let asked = if class == Class::Control {
            context.message(tid, &Wire { incarnation, number, body }).confirmed(within)
        } else {
            context.message(tid, &Parcel { incarnation, number, body }).confirmed(within)
        };
        let Ok(confirmation) = asked else { return self.report(&Entry::NotSent(way, number)) };
        self.waits += 1;
        let wait = confirmation.into_actor(self).map(move |outcome, this: &mut Self, _: &mut _| {
            this.waits -= 1;
            this.report(&Entry::Outcome(way, number, outcome));
        });
        context.spawn(wait);
    }

    /// Reports that it has received the message. Returns whether to refuse it.
    fn note(&mut self, from: Tid, class: Class, (incarnation, number): (u32, u64), body: &[u8]) -> bool {
        let from = (from.app.bits() - address(0).bits()) as Poster;
        if body.iter().any(|byte| *byte != number as u8) {
            self.report(&Entry::Broken(format!(
                "{number} of {from} in incarnation {incarnation} has other bytes"
            )));
        }
        self.report(&Entry::Got(from, incarnation, class, number));
        self.random.once_in(16)
    }
}

macro_rules! handles {
    ($type:ident, $class:ident) => {
        impl Handler<Delivery<$type>> for Resident {
            type Result = ();

            fn handle(&mut self, letter: Delivery<$type>, context: &mut Self::Context) {
                let which = (letter.incarnation, letter.number);
                if self.note(letter.source, Class::$class, which, &letter.body) {
                    context.reject();
                }
            }
        }
    };
}
handles!(Wire, Control);
handles!(Card, Stream);
handles!(Parcel, Bulk);
