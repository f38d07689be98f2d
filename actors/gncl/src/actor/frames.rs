//! Frames of this layer itself: those of the handshake and PINGs are written, and received ones become the
//! core's inputs.

use std::net::Shutdown;

use actix::{AsyncContext, Context, fut};
use sinew_runtime::{
    tid::NodeAddress,
    time::Time,
    wire::{Kind, Message},
};

use super::{
    super::{
        core::{ConnectionId, Input, Introduction, Lane, Refusal, RefusalError, read, write},
        frame::frame,
        link::{self, Mode},
    },
    Gncl,
};

/// The action after a frame on a connection that is not a link.
#[derive(Clone, Copy, PartialEq, Eq)]
enum AfterWrite {
    KeepOpen,
    Shut,
}

impl Gncl {
    pub(super) fn send_hello(
        &mut self,
        connection: ConnectionId,
        hello: &Introduction,
        ctx: &mut Context<Self>,
    ) {
        let hello = Introduction { datagrams_made: self.datagrams_made(), ..hello.clone() };
        let message = frame(self.state.ctx.node, hello.peer, Kind::GNCL_HELLO, write(&hello));
        self.write_frame(connection, message, AfterWrite::KeepOpen, ctx);
    }

    pub(super) fn refuse(&mut self, connection: ConnectionId, refusal: &Refusal, ctx: &mut Context<Self>) {
        let message = frame(self.state.ctx.node, NodeAddress::HERE, Kind::GNCL_REFUSAL, write(refusal));
        if let Some(wire) = self.wires.get(&connection) {
            wire.set_mode(Mode::Discard);
        }
        self.write_frame(connection, message, AfterWrite::Shut, ctx);
    }

    /// Writes a frame on a connection that is not a link.
    fn write_frame(
        &mut self,
        connection: ConnectionId,
        message: Message,
        then: AfterWrite,
        ctx: &mut Context<Self>,
    ) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let (Some(transport), may_write) = (wire.transport.clone(), wire.may_write) else { return };
        let task = async move {
            if may_write && link::write_frame(transport.clone(), &message).await.is_err() {
                // The reader gets the same error, and reports it to the core.
                return;
            }
            if then == AfterWrite::Shut {
                transport.shut(Shutdown::Write);
            }
        };
        wire.tasks.push(ctx.spawn(fut::wrap_future(task)));
    }

    pub(super) fn send(&self, node: NodeAddress, lane: Lane, kind: Kind) {
        if let Some(session) = self.state.store.peer(node).as_ref().and_then(|peer| peer.session(lane)) {
            session.send_urgent(frame(self.state.ctx.node, node, kind, bytes::Bytes::new()));
        }
    }

    pub(super) fn on_frame(&mut self, connection: ConnectionId, message: &Message, ctx: &mut Context<Self>) {
        let input =
            self.input_of(connection, message).unwrap_or_else(|decline| Input::Violated(connection, decline));
        if !matches!(input, Input::Violated(..) | Input::PingReceived(_) | Input::PongReceived(_)) {
            self.input(Input::FramesReceived(connection, Time::now()), ctx);
            self.mark_channel_alive(message.header.source.node);
        }
        if matches!(input, Input::GoodbyeReceived(_)) {
            return self.on_goodbye(connection, ctx);
        }
        self.input(input, ctx);
    }

    fn input_of(&mut self, connection: ConnectionId, message: &Message) -> Result<Input, RefusalError> {
        let mut introduction = || -> Result<Introduction, RefusalError> {
            let introduction: Introduction = read(&message.payload)?;
            if introduction.node != message.header.source.node {
                let what = "the source of this frame is another node than its sender says";
                return Err(RefusalError::Violation(what.to_owned()));
            }
            self.check_introduction(connection, &introduction)?;
            Ok(introduction)
        };
        match message.header.kind {
            Kind::GNCL_HELLO => Ok(Input::HelloReceived(connection, introduction()?)),
            Kind::GNCL_WELCOME => Ok(Input::WelcomeReceived(connection, introduction()?)),
            Kind::GNCL_REFUSAL => Ok(Input::RefusalReceived(connection, read(&message.payload)?)),
            Kind::GNCL_PING => Ok(Input::PingReceived(connection)),
            Kind::GNCL_PONG => Ok(Input::PongReceived(connection)),
            Kind::GNCL_GOODBYE => {
                self.record_leave_reason(message.header.source.node, &message.payload)?;
                Ok(Input::GoodbyeReceived(connection))
            }
            kind => Err(RefusalError::Violation(format!(
                "a frame of kind {kind} came before the handshake was over"
            ))),
        }
    }
}
