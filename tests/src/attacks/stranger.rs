//! A peer by hand, written from `docs/protocol/gncl.md`: TLS with any certificate, or none, HELLO with any words, and a session.

use std::{
    io::{self, Read, Write},
    net::{SocketAddr, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::BytesMut;
use serde::{Deserialize, Serialize};
use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    security::{
        PROTOCOL, Tls,
        rustls::{
            ClientConfig, ClientConnection, DigitallySignedStruct, Error, SignatureScheme, StreamOwned,
            client::{
                Resumption,
                danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
            },
            crypto::ring,
            pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime},
            version::TLS13,
        },
    },
};
use sinew_runtime::wire::{FrameCodec, Header, Kind, Message, decode, encode_frame};

use super::keys::{PROJECT, Who};

/// What is waited for of one connection: longer than `gncl.handshake`.
const PATIENCE: Duration = Duration::from_secs(4);
/// Longest payload that it reads.
const PAYLOAD_MAX: usize = 1 << 20;

/// How such a client speaks TLS.
pub(super) type Client = ClientConfig;

/// A client that takes any server, and shows this certificate.
pub(super) fn client(shown: Option<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>)>) -> Arc<Client> {
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&TLS13])
        .expect("the provider knows TLS 1.3")
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyServer));
    let mut client = match shown {
        Some((chain, key)) => builder.with_client_auth_cert(chain, key).expect("a key that was just made"),
        None => builder.with_no_client_auth(),
    };
    client.alpn_protocols = vec![PROTOCOL.to_vec()];
    client.resumption = Resumption::disabled();
    client.enable_sni = false;
    Arc::new(client)
}

/// An attacker does not care who is there.
#[derive(Debug)]
struct AnyServer;

impl ServerCertVerifier for AnyServer {
    fn verify_server_cert(
        &self,
        _: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        ring::default_provider().signature_verification_algorithms.supported_schemes()
    }
}

/// Bytes to the node: as they are, or sealed.
enum Wire {
    Open(TcpStream),
    Sealed(Box<StreamOwned<ClientConnection, TcpStream>>),
}

/// What was answered to a HELLO.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    Welcome,
    /// In the node's words.
    Refused(String),
}

/// A connection to the node that is attacked.
pub(super) struct Stranger {
    wire: Wire,
    /// As which life of its node it says hello.
    life: u64,
    codec: FrameCodec,
    read: BytesMut,
}

/// Payload of HELLO.
#[derive(Serialize)]
struct Hello {
    project: &'static str,
    node: NodeAddress,
    name: &'static str,
    incarnation: u64,
    peer: NodeAddress,
    dial: u64,
    payload_max: u64,
    features: [String; 0],
}

#[derive(Deserialize)]
struct Refusal {
    sentence: String,
}

/// Payload of ACK.
#[derive(Serialize, Deserialize)]
struct Ack {
    memory: u64,
    epoch: u64,
    of: u64,
    next: u64,
}

/// Each dial of a life has a larger number.
fn next_dial() -> u64 {
    static DIALS: AtomicU64 = AtomicU64::new(0);
    Time::now().as_nanos() + DIALS.fetch_add(1, Ordering::Relaxed)
}

impl Stranger {
    /// Connects, and speaks TLS if it has a client for that. In TLS 1.3 it does not know yet whether it is taken.
    pub(super) fn dial(to: SocketAddr, client: Option<&Arc<Client>>) -> io::Result<Self> {
        let mut socket = TcpStream::connect_timeout(&to, PATIENCE)?;
        socket.set_read_timeout(Some(PATIENCE))?;
        socket.set_write_timeout(Some(PATIENCE))?;
        socket.set_nodelay(true)?;
        let wire = match client {
            None => Wire::Open(socket),
            Some(client) => {
                let mut tls =
                    ClientConnection::new(client.clone(), Tls::server_name()).map_err(io::Error::other)?;
                while tls.is_handshaking() {
                    tls.complete_io(&mut socket)?;
                }
                Wire::Sealed(Box::new(StreamOwned::new(tls, socket)))
            }
        };
        Ok(Self { wire, life: 1, codec: FrameCodec::new(PAYLOAD_MAX), read: BytesMut::new() })
    }

    /// The same as a life of its node that is later than all before: one that has forgotten what passed on former connections.
    pub(super) fn in_a_new_life(self) -> Self {
        Self { life: next_dial(), ..self }
    }

    /// Says that it is this node, and reads what is answered.
    pub(super) fn hello(&mut self, says: Who, peer: NodeAddress) -> io::Result<Answer> {
        self.say_hello(says, peer)?;
        let answer = self.receive()?;
        match answer.header.kind {
            Kind::GNCL_WELCOME => Ok(Answer::Welcome),
            Kind::GNCL_REFUSAL => {
                let refusal: Refusal = decode(&answer.payload).map_err(io::Error::other)?;
                Ok(Answer::Refused(refusal.sentence))
            }
            other => Err(io::Error::other(format!("a frame of kind {other} is no answer to a HELLO"))),
        }
    }

    /// Says that it is this node.
    pub(super) fn say_hello(&mut self, says: Who, peer: NodeAddress) -> io::Result<()> {
        let node = says.node();
        let hello = Hello {
            project: PROJECT,
            node,
            name: says.name,
            incarnation: self.life,
            peer,
            dial: next_dial(),
            payload_max: PAYLOAD_MAX as u64,
            features: [],
        };
        let header =
            Header::new(Kind::GNCL_HELLO, Tid::new(node, AppAddress::GNCL), Tid::new(peer, AppAddress::GNCL));
        self.send(&header, &words(&hello))
    }

    /// Begins the session: says that it has taken nothing, and waits for the node to say the same. Messages from 1 on may follow.
    pub(super) fn begin_session(&mut self, own: Who, peer: NodeAddress) -> io::Result<()> {
        let ack = Ack { memory: next_dial(), epoch: 1, of: 0, next: 1 };
        let gncl = |node| Tid::new(node, AppAddress::GNCL);
        self.send(&Header::new(Kind::GNCL_ACK, gncl(own.node()), gncl(peer)), &words(&ack))?;
        while self.receive()?.header.kind != Kind::GNCL_ACK {}
        Ok(())
    }

    /// Waits until the node says that it has taken all messages up to this one: who goes before loses what is under way.
    pub(super) fn wait_for_taken(&mut self, last: u64) -> io::Result<()> {
        let until = Instant::now() + PATIENCE;
        while Instant::now() < until {
            let message = self.receive()?;
            if message.header.kind != Kind::GNCL_ACK {
                continue;
            }
            let ack: Ack = decode(&message.payload).map_err(io::Error::other)?;
            if ack.next > last {
                return Ok(());
            }
        }
        Err(io::Error::other(format!(
            "the node did not say within {PATIENCE:?} that it has taken message {last}"
        )))
    }

    /// Sends one frame.
    pub(super) fn send(&mut self, header: &Header, payload: &[u8]) -> io::Result<()> {
        let mut bytes = BytesMut::new();
        encode_frame(header, payload, &mut bytes);
        self.write(&bytes)
    }

    /// Writes any bytes.
    pub(super) fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        match &mut self.wire {
            Wire::Open(socket) => socket.write_all(bytes),
            Wire::Sealed(stream) => stream.write_all(bytes).and_then(|()| stream.flush()),
        }
    }

    /// The next frame.
    pub(super) fn receive(&mut self) -> io::Result<Message> {
        use tokio_util::codec::Decoder as _;
        loop {
            if let Some(message) = self.codec.decode(&mut self.read).map_err(io::Error::other)? {
                return Ok(message);
            }
            let mut chunk = [0; 4_096];
            let count = match &mut self.wire {
                Wire::Open(socket) => socket.read(&mut chunk)?,
                Wire::Sealed(stream) => stream.read(&mut chunk)?,
            };
            if count == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            self.read.extend_from_slice(&chunk[..count]);
        }
    }
}

/// The MessagePack form of such words.
pub(super) fn words<T: Serialize>(said: &T) -> Vec<u8> {
    rmp_serde::to_vec_named(said).expect("texts and numbers can be written")
}
