//! The registration of commands, and of the connections of their processes.

use std::sync::Arc;

use rustix::process::{Pid, getpgid};
use sinew_model::facts::User;
use sinew_runtime::{
    lock,
    router::LocalRoute,
    tid::{AppAddress, Tid},
    wire::Kind,
};
use sinew_session::book::ClientId;
use tokio::net::UnixStream;

use super::{
    super::{
        command::{ClaimError, CommandPort, HandOver},
        core::{Address, Owner, RegisterError, Request},
        process_watch::has_ended,
    },
    LocalApp, limits, notify_handled, register_own,
};
use crate::State;

/// Registers a command of the node with the sink `port`. The processes that the node starts for it connect as clients
/// later; until then its messages wait.
///
/// # Errors
/// The reason; nothing changed.
pub fn register_command(state: &State, app: LocalApp, port: Arc<CommandPort>) -> Result<Tid, RegisterError> {
    let tid = register_own(state, app, Owner::Command)?;
    state.commands.add(port);
    Ok(tid)
}

/// Gives the address of a command to a connection of one of its processes. No message reaches it before
/// [`open_command`].
///
/// # Errors
/// The reason; nothing changed. spec: LNCL-22
pub(crate) fn claim_command(
    state: &State,
    port: &CommandPort,
    (id, pid, socket): (ClientId, i32, &UnixStream),
    request: &Request,
) -> Result<AppAddress, RegisterError> {
    let refused = |why| RegisterError::Command { name: port.name().to_owned(), why };
    // Only the node's own user has a process in a group that the node started.
    let is_own = request.user == User::Own;
    let group = Pid::from_raw(pid).filter(|_| is_own).and_then(|pid| getpgid(Some(pid)).ok());
    // Checked after its group was read: as long as the process lives, no other one has its number.
    let group = group.filter(|_| !has_ended(socket));
    let mut registry = lock(&state.registry);
    let Some(app) = registry.resolve(port.name()) else { return Err(refused(ClaimError::Stray(pid))) };
    port.claim(id, pid, group.map(|group| group.as_raw_nonzero().get())).map_err(refused)?;
    let declared = if !request.requires.is_empty() {
        Err(refused(ClaimError::Requires))
    } else if matches!(request.address, Address::Fixed(_)) {
        Err(refused(ClaimError::Address))
    } else {
        registry.declare_kinds(app, &request.kinds, limits(state))
    };
    declared.inspect_err(|_| _ = port.release(id))?;
    notify_handled(state, app, request.kinds.iter().map(|name| Kind::named(name)).collect());
    Ok(app)
}

/// Opens the route to the process of a command: it gets messages from now on. Its supervisor reports it as ready.
pub(crate) fn open_command(
    state: &State,
    (port, app): (&Arc<CommandPort>, AppAddress),
    id: ClientId,
    (queue, events): (Arc<dyn HandOver>, Arc<[Kind]>),
) {
    {
        let registry = lock(&state.registry);
        if registry.owner_of(app) != Some(Owner::Command) || !port.is_held_by(id) {
            return;
        }
        state.ctx.router.set_local(app, LocalRoute { sink: port.clone(), events });
    }
    port.open(id, queue);
}

/// Takes the address of a command from a connection that has ended.
pub(crate) fn release_command(state: &State, port: &CommandPort, app: AppAddress, id: ClientId) {
    let registry = lock(&state.registry);
    if port.release(id)
        && registry.owner_of(app) == Some(Owner::Command)
        && let Some(types) = state.ctx.ports.app_types()
    {
        types.forget(app);
    }
}
