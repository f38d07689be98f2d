//! Accepted and refused peers, with the texts of refusals.

use sinew_model::facts::LinkFact;
use sinew_runtime::{
    tid::Tid,
    wire::{Checksum, Header, Kind, Message},
};
use tokio::net::TcpListener;

use super::bench::{ByHand, KIND, NINE, Node, introduction, run, within};
use crate::{
    core::{Introduction, read, write},
    frame::frame,
};

#[test]
fn each_fault_of_a_hello_has_its_refusal() {
    run(async {
        let node = Node::start(1).await;
        let right = introduction(node.address());
        let cases = [
            (Introduction { project: "arm".to_owned(), ..right.clone() }, "other project"),
            (Introduction { peer: NINE, ..right.clone() }, "wrong node"),
        ];
        for (hello, cause) in cases {
            let mut peer = ByHand::dial(&node).await;
            peer.send(&frame(hello.node, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
            let refusal = peer.refusal().await;
            assert_eq!(refusal.cause, cause);
            assert!(refusal.sentence.len() > 20, "{} is no sentence", refusal.sentence);
            assert_eq!(node.state.store.refusals.of(cause), 1);
        }
    });
}

#[test]
fn nodes_with_one_address_refuse_each_other() {
    run(async {
        let (a, b) =
            (Node::start(1).await, Node::start_with(1, |config| config.name = "twin".to_owned()).await);
        let mut peer = ByHand::dial(&a).await;
        let hello = Introduction {
            node: b.address(),
            name: b.state.ctx.config.name.clone(),
            ..introduction(a.address())
        };
        peer.send(&frame(b.address(), a.address(), Kind::GNCL_HELLO, write(&hello))).await;
        let refusal = peer.refusal().await;
        assert_eq!(refusal.cause, "own address");
        assert!(refusal.sentence.contains("0.0.0.1") && refusal.sentence.contains("twin"));
    });
}

#[test]
fn nodes_of_two_projects_both_know_the_reason() {
    run(async {
        let a = Node::start(1).await;
        let b = Node::start_with(2, |config| config.project = "arm".to_owned()).await;
        a.find(b.address(), b.listens_at());
        b.counted("other project").await;
        a.counted("refused by the peer").await;
    });
}

#[test]
fn other_version_is_refused_in_both_directions() {
    run(async {
        let node = Node::start(1).await;
        let mut ours = ByHand::dial(&node).await;
        let mut hello = b"Sw\x02\x40".to_vec();
        hello.resize(64, 0);
        ours.send_bytes(&hello).await;
        let refusal = ours.refusal().await;
        assert_eq!(refusal.cause, "version");
        assert!(refusal.sentence.contains("version 2") && refusal.sentence.contains("version 1"));

        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        node.find(NINE, listener.local_addr().unwrap());
        let (socket, _) = within("the node's dial", listener.accept()).await.unwrap();
        let mut theirs = ByHand::on(socket);
        assert_eq!(theirs.receive().await.header.kind, Kind::GNCL_HELLO);
        theirs.send_bytes(&hello).await;
        assert_eq!(theirs.refusal().await.cause, "version");
        assert_eq!(node.state.store.refusals.of("version"), 2);
    });
}

#[test]
fn invalid_frames_end_their_own_connection_only() {
    run(async {
        let mut node = Node::start(1).await;
        let mut good = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let oversized = {
            let mut bytes = b"Sw\x01\x40\xff\xff\xff\x7f".to_vec();
            bytes.resize(64, 0);
            bytes
        };
        let hello = frame(NINE, node.address(), Kind::GNCL_HELLO, write(&introduction(node.address())));
        let mut damaged = hello.header.encode(&hello.payload).to_vec();
        damaged.extend_from_slice(&hello.payload);
        damaged[70] ^= 1;
        for garbage in [b"GET / HTTP/1.1\r\n\r\n".to_vec(), oversized, damaged] {
            let mut peer = ByHand::dial(&node).await;
            peer.send_bytes(&garbage).await;
            assert_eq!(peer.refusal().await.cause, "violation");
        }
        let mut truncated = ByHand::dial(&node).await;
        truncated.send_bytes(&hello.header.encode(&hello.payload)[..40]).await;
        drop(truncated);
        let mut too_early = ByHand::dial(&node).await;
        too_early.send(&node.message(node.tid(1), b"no hello")).await;
        assert_eq!(too_early.refusal().await.cause, "violation");

        let mut message = node.message(node.tid(1), b"still here");
        message.header.source.node = NINE;
        good.send(&message).await;
        assert_eq!(&super::bench::next("the message", &mut inbox).await.payload[..], b"still here");
    });
}

#[test]
fn garbage_breaks_a_link_which_is_restored() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.send_bytes(&[0xaa; 200]).await;
        assert_eq!(peer.refusal().await.cause, "violation");
        node.broken().await;
        let mut again = ByHand::dial(&node).await;
        let hello = Introduction { dial: 2, ..introduction(node.address()) };
        again.send(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
        assert_eq!(again.receive().await.header.kind, Kind::GNCL_WELCOME);
        node.up().await;
    });
}

#[test]
fn silent_connection_is_refused_as_too_late() {
    run(async {
        let node =
            Node::start_with(1, |config| config.gncl.handshake = std::time::Duration::from_millis(50)).await;
        let silent = ByHand::dial(&node).await;
        assert_eq!(silent.refusal().await.cause, "too late");
    });
}

#[test]
fn refused_dial_is_reported_to_ndl() {
    run(async {
        let mut node = Node::start(1).await;
        let nobody = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
        node.find(NINE, nobody);
        assert!(matches!(node.fact().await, LinkFact::DialRefused { node: NINE, .. }));
    });
}

#[test]
fn own_hello_carries_both_identities() {
    run(async {
        let node = Node::start(1).await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        node.find(NINE, listener.local_addr().unwrap());
        let (socket, _) = within("the node's dial", listener.accept()).await.unwrap();
        let hello = ByHand::on(socket).receive().await;
        let said: Introduction = read(&hello.payload).unwrap();
        assert_eq!((said.node, said.peer, said.name.as_str()), (node.address(), NINE, "node-1"));
        assert_eq!(said.payload_max, 1 << 20);
        assert!(said.dial > 0);
    });
}

#[test]
fn damaged_length_ends_a_guarded_link_at_the_header() {
    run(async {
        let mut node = Node::start(1).await;
        let hello = Introduction { features: vec!["guard".to_owned()], ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        node.up().await;
        let mut message = Message::new(
            Header::new(KIND, Tid::new(NINE, node.tid(1).app), node.tid(2)),
            vec![7; 100].into(),
        );
        message.header.number = 1;
        let mut head = Checksum::Guarded.encode(&message.header, &message.payload);
        // 100 bytes become 65,636.
        head[6] ^= 1;
        peer.send_bytes(&head).await;
        peer.send_bytes(&message.payload).await;
        assert_eq!(peer.refusal().await.cause, "violation");
    });
}
