//! The first frame of a connection.

use sinew_protocol::payload::Register;
use tokio::net::UnixStream;

use crate::{
    reader::Reader,
    session::{Order, Session},
};

/// Returns the first frame, or `None` if the peer closed the connection before it.
pub(super) async fn receive(
    reader: &mut Reader,
    stream: &UnixStream,
    session: &mut Session,
) -> Result<Option<Register>, String> {
    let Some(message) = reader.next(stream).await.map_err(|error| error.to_string())? else {
        return Ok(None);
    };
    match session.handle(message) {
        Order::Register(register) => Ok(Some(register)),
        Order::End(violation) => Err(violation.to_string()),
        Order::Route(_)
        | Order::Settle { .. }
        | Order::SetMember { .. }
        | Order::RefuseMembership { .. }
        | Order::Resolve { .. }
        | Order::Introduce { .. }
        | Order::Switch { .. }
        | Order::DeclareType(_)
        | Order::Ready
        | Order::Observe(_)
        | Order::RefuseMessage { .. }
        | Order::Unregister => Err("an unregistered connection can only register".to_owned()),
    }
}
