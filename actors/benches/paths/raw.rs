//! The reference within a process: bare actix, the same payload there and back.

use std::time::Instant;

use actix::{Actor, Context, Handler, Message};
use actix_rt::Arbiter;
use sinew_figures::{End, Figures, Pinning};

use crate::rounds;

struct Bare;

impl Actor for Bare {
    type Context = Context<Self>;
}

struct Block(Vec<u8>);

impl Message for Block {
    type Result = Vec<u8>;
}

impl Handler<Block> for Bare {
    type Result = Vec<u8>;

    fn handle(&mut self, block: Block, _: &mut Context<Self>) -> Vec<u8> {
        block.0
    }
}

/// Round trips by actix's own `Addr::send`, a payload allocated for each.
pub(crate) fn actix_send(bytes: usize, pinning: Pinning, same_arbiter: bool) -> Figures {
    let system = actix::System::new();
    system.block_on(async move {
        let (first, second) = (arbiter(pinning, End::Measuring), arbiter(pinning, End::Echoing));
        let there = if same_arbiter { first.handle() } else { second.handle() };
        let bare = Bare::start_in_arbiter(&there, |_| Bare);
        let (give, given) = tokio::sync::oneshot::channel();
        first.spawn(async move {
            let mut figures = Figures::new();
            let rounds = rounds(bytes);
            for round in 0..rounds.warm_up + rounds.counted {
                let start = Instant::now();
                let block = bare.send(Block(vec![7; bytes])).await.expect("the actor lives");
                assert_eq!(block.len(), bytes);
                if round >= rounds.warm_up {
                    figures.record(start.elapsed());
                }
            }
            // The receiver waits for it.
            let _ = give.send(figures);
        });
        given.await.expect("the rounds end")
    })
}

fn arbiter(pinning: Pinning, end: End) -> Arbiter {
    Arbiter::with_tokio_rt(move || {
        pinning.pin(end);
        tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor")
    })
}
