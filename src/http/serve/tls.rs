//! The certificate of the service, and the handshakes with it.
//!
//! Certificates expire, so they are replaced while the server runs. Each handshake uses what was
//! last read without a fault; files that cannot be used leave the old certificate in force.

use crate::http::config::HttpConfig;
use crate::ops::reload;
use rustls::ServerConfig;
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::sync::watch;
use tokio::task::spawn_blocking;
use tokio_rustls::TlsAcceptor;
use tokio_util::task::AbortOnDropHandle;

/// The only protocol spoken within TLS.
const HTTP_1: &[u8] = b"http/1.1";

/// The settings name a certificate that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TlsError {
    /// The chain cannot be read.
    #[error("cannot read the certificate chain {}", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// Why.
        source: pem::Error,
    },
    /// The file of the chain is PEM without a certificate.
    #[error("there is no certificate in {}", path.display())]
    NoCertificate {
        /// The file.
        path: PathBuf,
    },
    /// The key cannot be read.
    #[error("cannot read the private key {}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// Why.
        source: pem::Error,
    },
    /// Chain and key do not belong together, or are of a kind that is not supported.
    #[error(
        "the certificate {} cannot be used with the key {}",
        certificate.display(),
        key.display()
    )]
    Unusable {
        /// The file of the chain.
        certificate: PathBuf,
        /// The file of the key.
        key: PathBuf,
        /// Why.
        source: rustls::Error,
    },
    /// Changes of the files cannot be followed.
    #[error("the certificate cannot be watched")]
    Watch(#[source] io::Error),
}

/// The files of a certificate.
#[derive(Debug, Clone)]
struct CertificateFiles {
    certificate: PathBuf,
    key: PathBuf,
}

/// The certificate in force, which follows its files for as long as this lives.
pub struct Certificate {
    current: watch::Receiver<Arc<ServerConfig>>,
    _following: AbortOnDropHandle<()>,
}

impl Certificate {
    /// Reads the certificate that the settings name, and follows its files; `None` if they name
    /// none.
    ///
    /// # Errors
    /// The files cannot be used.
    pub async fn open(config: &HttpConfig) -> Result<Option<Self>, TlsError> {
        let (Some(certificate), Some(key)) = (&config.tls_cert, &config.tls_key) else {
            return Ok(None);
        };
        let files = CertificateFiles {
            certificate: certificate.clone(),
            key: key.clone(),
        };
        // Before the files are read, so that no change falls between.
        let changes = reload::watch(vec![files.certificate.clone(), files.key.clone()])
            .map_err(TlsError::Watch)?;
        let (sender, current) = watch::channel(files.read()?);
        let following = tokio::spawn(follow(files, changes, sender));
        Ok(Some(Self {
            current,
            _following: AbortOnDropHandle::new(following),
        }))
    }

    /// What makes the next handshake.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(self.current.borrow().clone())
    }
}

/// Puts each certificate in force that the files come to hold.
async fn follow(
    files: CertificateFiles,
    mut changes: watch::Receiver<u64>,
    current: watch::Sender<Arc<ServerConfig>>,
) {
    while changes.changed().await.is_ok() {
        let wanted = files.clone();
        // It fails only if the runtime ends.
        let Ok(read) = spawn_blocking(move || wanted.read()).await else {
            return;
        };
        match read {
            Ok(config) => {
                current.send_replace(config);
                tracing::info!(file = %files.certificate.display(), "read the certificate again");
            }
            Err(error) => {
                let cause = std::error::Error::source(&error).map(ToString::to_string);
                tracing::error!(%error, cause, "the certificate in force stays: the new is broken");
            }
        }
    }
}

impl CertificateFiles {
    fn read(&self) -> Result<Arc<ServerConfig>, TlsError> {
        let chain = read_chain(&self.certificate)?;
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(|source| TlsError::Key {
            path: self.key.clone(),
            source,
        })?;
        let unusable = |source| TlsError::Unusable {
            certificate: self.certificate.clone(),
            key: self.key.clone(),
            source,
        };
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(unusable)?
            .with_no_client_auth()
            .with_single_cert(chain, key)
            .map_err(unusable)?;
        config.alpn_protocols = vec![HTTP_1.to_vec()];
        Ok(Arc::new(config))
    }
}

fn read_chain(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let chain: Result<Vec<_>, _> =
        CertificateDer::pem_file_iter(path).and_then(|certificates| certificates.collect());
    let chain = chain.map_err(|source| TlsError::Certificate {
        path: path.to_owned(),
        source,
    })?;
    if chain.is_empty() {
        let path = path.to_owned();
        return Err(TlsError::NoCertificate { path });
    }
    Ok(chain)
}
