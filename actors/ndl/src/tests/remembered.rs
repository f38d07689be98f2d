//! A restarted node finds its peers by the contents of its file.

use std::{
    fs::Permissions,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
};

use sinew_model::config::NodeConfig;
use sinew_runtime::{lock, tid::NodeAddress};

use super::{Node, Source, alone, free_port, lock_core, run, within};

/// Time between two checks of a file.
const LOOK: std::time::Duration = std::time::Duration::from_millis(10);

fn config(number: u32, port: u16, state: Option<&Path>) -> NodeConfig {
    let mut config = NodeConfig::new(format!("node-{number}"));
    config.address = Some(NodeAddress::new(number));
    config.state = state.map(Path::to_owned);
    alone(&mut config.ndl);
    config.ndl.port = port;
    config
}

async fn started(config: NodeConfig, incarnation: u64) -> Node {
    let mut node = Node::of(config, incarnation);
    node.start_layer().await;
    node
}

fn ended(mut node: Node) {
    node.end_layer();
    lock(&node.state.sockets).close_all();
}

struct Own(PathBuf);

impl Own {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("sinew-remembered-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Own {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Both meet by a seed; the second keeps that, in `state`. Then both end.
async fn meet(ports: [u16; 2], state: &Path) {
    let mut first = started(config(1, ports[0], None), 1).await;
    let mut config = config(2, ports[1], Some(state));
    config.ndl.seeds = vec![first.udp().into()];
    let mut second = started(config, 1).await;
    first.finds(&second).await;
    second.finds(&first).await;
    let file = state.join("peers-sinew-0.0.0.2");
    let expected = format!("sinew peers 1\n127.0.0.1:{} 0.0.0.1 0\n", ports[0]);
    within("the file of peers", async {
        while std::fs::read_to_string(&file).ok().as_ref() != Some(&expected) {
            tokio::time::sleep(LOOK).await;
        }
    })
    .await;
    ended(second);
    ended(first);
}

#[test]
fn restarted_node_finds_its_peers_without_any_source() {
    run(async {
        let (own, ports) = (Own::new("found"), [free_port(), free_port()]);
        meet(ports, &own.0).await;
        let mut first = started(config(1, ports[0], None), 2).await;
        let mut second = started(config(2, ports[1], Some(&own.0)), 2).await;
        second.finds(&first).await;
        first.finds(&second).await;
        assert!(second.sources().contains(&Source::Remembered), "{:?}", second.sources());
        assert_eq!(first.sources(), [Source::Query]);
    });
}

#[test]
fn garbage_in_the_file_is_skipped() {
    run(async {
        let (own, ports) = (Own::new("rubbish"), [free_port(), free_port()]);
        meet(ports, &own.0).await;
        let file = own.0.join("peers-sinew-0.0.0.2");
        let mut bytes = std::fs::read(&file).unwrap();
        bytes.extend(b"\xff\xfe\0 0 0\n10.0.0.1:1 10.0.0.1 99999999999999999999\n");
        std::fs::write(&file, &bytes).unwrap();
        let mut first = started(config(1, ports[0], None), 2).await;
        let mut second = started(config(2, ports[1], Some(&own.0)), 2).await;
        second.finds(&first).await;
        first.finds(&second).await;
        ended(second);
        // And: a file with garbage only.
        std::fs::write(&file, b"\0\xff").unwrap();
        let mut second = started(config(2, ports[1], Some(&own.0)), 3).await;
        // The first node, which still knows the second, sends the query.
        second.finds(&first).await;
        within("the file to be looked at", async {
            while !lock_core(&second.state).has_loaded_remembered() {
                tokio::time::sleep(LOOK).await;
            }
        })
        .await;
    });
}

#[test]
fn unreadable_file_loses_no_newly_met_peers() {
    run(async {
        // given
        let (own, ports) = (Own::new("unreadable"), [free_port(), free_port()]);
        meet(ports, &own.0).await;
        let file = own.0.join("peers-sinew-0.0.0.2");
        let kept = std::fs::read_to_string(&file).unwrap();
        // Others could have written it: it is not read.
        std::fs::set_permissions(&file, Permissions::from_mode(0o622)).unwrap();
        // when
        let mut third = started(config(3, free_port(), None), 1).await;
        let mut config = config(2, ports[1], Some(&own.0));
        config.ndl.seeds = vec![third.udp().into()];
        let mut second = started(config, 2).await;
        second.finds(&third).await;
        third.finds(&second).await;
        // It is repaired in place: a node that has replaced it meanwhile has lost its contents.
        std::fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
        // then
        let expected = format!("{kept}127.0.0.1:{} 0.0.0.3 0\n", third.udp().port());
        within("the file to have both", async {
            while std::fs::read_to_string(&file).ok().as_ref() != Some(&expected) {
                tokio::time::sleep(LOOK).await;
            }
        })
        .await;
    });
}
