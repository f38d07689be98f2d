//! Posters that live in the node's own process, as ordinary applications. They do not wait for one outcome before they ask
//! for the next.

use std::{collections::BTreeMap, time::Duration};

use sinew::prelude::*;

use super::{
    entry::{Entry, Poster, Way},
    poster::{Card, Parcel, Wire, body, is_posting, within},
    registration::address,
    say,
};
use crate::{DEADLINE, dice::Dice};

/// Time between two turns of a poster.
const TURN: Duration = Duration::from_millis(10);
/// Outcomes that it waits for at a time, at most.
const WAITS_MAX: usize = 32;

/// The poster `me` of so many.
pub(super) fn app(me: Poster, all: Poster, seed: u64) -> AppSpec<Resident> {
    let make = move || Resident {
        me,
        all,
        dice: Dice::new(seed ^ u64::from(me) << 40),
        numbers: BTreeMap::new(),
        waits: 0,
        is_quiet: false,
    };
    AppSpec::new(format!("poster {me}"), make)
        .address(address(me))
        .handles::<Wire>()
        .handles::<Card>()
        .handles::<Parcel>()
        // The director may be slow to hear what it tells.
        .progress_within(DEADLINE)
        .place(Place::thread(format!("posters {}", me % 2)))
}

pub(super) struct Resident {
    me: Poster,
    all: Poster,
    dice: Dice,
    numbers: BTreeMap<Way, u64>,
    waits: usize,
    is_quiet: bool,
}

impl Actor for Resident {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.tell(&Entry::Up(Time::now()));
        context.every(TURN, |this, _, context| this.take_turn(context));
    }
}

impl Resident {
    fn tell(&self, entry: &Entry) {
        say(&format!("{} {entry}", self.me));
    }

    fn take_turn(&mut self, context: &mut AppContext<Self>) {
        if is_posting() {
            self.send_one(context);
            for _ in 0..2 {
                self.ask_one(context);
            }
        } else if self.waits == 0 && !self.is_quiet {
            self.is_quiet = true;
            self.tell(&Entry::Quiet);
        }
    }

    fn next(&mut self, class: Class, context: &AppContext<Self>) -> (Way, Tid, u64) {
        let other = (self.me + 1 + self.dice.below(u32::from(self.all) - 1) as Poster) % self.all;
        let way = Way { to: other, class };
        let number = self.numbers.entry(way).or_default();
        *number += 1;
        (way, Tid::new(context.tid().node, address(other)), *number)
    }

    fn send_one(&mut self, context: &AppContext<Self>) {
        let class = [Class::Control, Class::Stream, Class::Bulk][self.dice.below(3) as usize];
        let (way, tid, number) = self.next(class, context);
        let (life, body) = (1, body(&mut self.dice, number));
        self.tell(&Entry::Sends(way, number, 1, Time::now()));
        let sent = match class {
            Class::Control => context.send(tid, &Wire { life, number, body }),
            Class::Stream => context.send(tid, &Card { life, number, body }),
            Class::Bulk => context.send(tid, &Parcel { life, number, body }),
        };
        if sent.is_err() {
            self.tell(&Entry::NotSent(way, number));
        }
    }

    fn ask_one(&mut self, context: &mut AppContext<Self>) {
        if self.waits >= WAITS_MAX {
            return;
        }
        let class = if self.dice.once_in(2) { Class::Control } else { Class::Bulk };
        let (way, tid, number) = self.next(class, context);
        let (life, body, within) = (1, body(&mut self.dice, number), within(&mut self.dice));
        self.tell(&Entry::Asks(way, number, Time::now()));
        let asked = if class == Class::Control {
            context.message(tid, &Wire { life, number, body }).confirmed(within)
        } else {
            context.message(tid, &Parcel { life, number, body }).confirmed(within)
        };
        let Ok(confirmation) = asked else { return self.tell(&Entry::NotSent(way, number)) };
        self.waits += 1;
        let wait = confirmation.into_actor(self).map(move |outcome, this: &mut Self, _: &mut _| {
            this.waits -= 1;
            this.tell(&Entry::Outcome(way, number, outcome));
        });
        context.spawn(wait);
    }

    /// Says that it has it in its hand; whether to refuse it.
    fn note(&mut self, from: Tid, class: Class, (life, number): (u32, u64), body: &[u8]) -> bool {
        let from = (from.app.bits() - address(0).bits()) as Poster;
        if body.iter().any(|byte| *byte != number as u8) {
            self.tell(&Entry::Broken(format!("{number} of {from} in life {life} has other bytes")));
        }
        self.tell(&Entry::Got(from, life, class, number));
        self.dice.once_in(16)
    }
}

macro_rules! handles {
    ($type:ident, $class:ident) => {
        impl Handler<Delivery<$type>> for Resident {
            type Result = ();

            fn handle(&mut self, letter: Delivery<$type>, context: &mut Self::Context) {
                let which = (letter.life, letter.number);
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
