//! A hand-written peer, implemented from `docs/protocol/gncl.md`: TLS with any certificate or none, HELLO
//! with any content, and a session.

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

use super::keys::{PROJECT, TestNode};

/// Timeout of one connection: longer than `gncl.handshake`.
const TIMEOUT: Duration = Duration::from_secs(4);
/// Maximum length of a payload that it reads.
const PAYLOAD_MAX: usize = 1 << 20;

/// The TLS configuration of such a client.
pub(super) type Client = ClientConfig;

/// A client that accepts any server and presents this certificate.
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

/// Accepts any server: an attacker does not authenticate its target.
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

/// The byte stream to the node: plain or encrypted.
enum Wire {
    Open(TcpStream),
    Sealed(Box<StreamOwned<ClientConnection, TcpStream>>),
}

/// The reply to a HELLO.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    Welcome,
    /// With the reason given by the node.
    Refused(String),
}

/// A connection to the attacked node.
pub(super) struct RawPeer {
    wire: Wire,
    /// The incarnation of its node that it claims in HELLO.
    incarnation: u64,
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

/// Each dial of an incarnation has a larger number.
fn next_dial() -> u64 {
    static DIALS: AtomicU64 = AtomicU64::new(0);
    Time::now().as_nanos() + DIALS.fetch_add(1, Ordering::Relaxed)
}

impl RawPeer {
    /// Connects, and performs the TLS handshake if a client is given. In TLS 1.3 the client does not know yet
    /// whether the server has accepted it.
    pub(super) fn dial(to: SocketAddr, client: Option<&Arc<Client>>) -> io::Result<Self> {
        let mut socket = TcpStream::connect_timeout(&to, TIMEOUT)?;
        socket.set_read_timeout(Some(TIMEOUT))?;
        socket.set_write_timeout(Some(TIMEOUT))?;
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
        Ok(Self { wire, incarnation: 1, codec: FrameCodec::new(PAYLOAD_MAX), read: BytesMut::new() })
    }

    /// The same connection with a later incarnation of its node than all before: one without the state of
    /// former connections.
    pub(super) fn in_a_new_incarnation(self) -> Self {
        Self { incarnation: next_dial(), ..self }
    }

    /// Sends HELLO as this node, and reads the reply.
    pub(super) fn hello(&mut self, claimed: TestNode, peer: NodeAddress) -> io::Result<Answer> {
        self.send_hello(claimed, peer)?;
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

    /// Sends HELLO as this node.
    pub(super) fn send_hello(&mut self, claimed: TestNode, peer: NodeAddress) -> io::Result<()> {
        let node = claimed.node();
        let hello = Hello {
            project: PROJECT,
            node,
            name: claimed.name,
            incarnation: self.incarnation,
            peer,
            dial: next_dial(),
            payload_max: PAYLOAD_MAX as u64,
            features: [],
        };
        let header =
            Header::new(Kind::GNCL_HELLO, Tid::new(node, AppAddress::GNCL), Tid::new(peer, AppAddress::GNCL));
        self.send(&header, &words(&hello))
    }

    /// Starts the session: reports that it has received nothing, and waits for the same report from the node.
    /// Messages from number 1 on may follow.
    pub(super) fn begin_session(&mut self, own: TestNode, peer: NodeAddress) -> io::Result<()> {
        let ack = Ack { memory: next_dial(), epoch: 1, of: 0, next: 1 };
        let gncl = |node| Tid::new(node, AppAddress::GNCL);
        self.send(&Header::new(Kind::GNCL_ACK, gncl(own.node()), gncl(peer)), &words(&ack))?;
        while self.receive()?.header.kind != Kind::GNCL_ACK {}
        Ok(())
    }

    /// Waits until the node acknowledges all messages up to this one: a client that disconnects earlier loses
    /// those in flight.
    pub(super) fn wait_for_taken(&mut self, last: u64) -> io::Result<()> {
        let until = Instant::now() + TIMEOUT;
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
        Err(io::Error::other(format!("the node did not acknowledge message {last} within {TIMEOUT:?}")))
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

    /// Reads the next frame.
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

/// Encodes a value as MessagePack.
pub(super) fn words<T: Serialize>(value: &T) -> Vec<u8> {
    rmp_serde::to_vec_named(value).expect("texts and numbers can be written")
}
