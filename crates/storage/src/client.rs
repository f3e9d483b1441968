//! Requests to stores: one client a bucket, on a runtime of its own, and what its errors mean.

use std::{
    collections::HashMap,
    error::Error as _,
    io,
    path::Path,
    sync::{Arc, LazyLock, Mutex, PoisonError, mpsc},
    time::Duration,
};

use object_store::{
    BackoffConfig, Error, ObjectStore, RetryConfig, StaticCredentialProvider,
    aws::AmazonS3Builder,
    gcp::{GcpCredential, GoogleCloudStorageBuilder, GoogleConfigKey},
    path::Path as Key,
};
use tokio::runtime::{Builder, Runtime};
use url::Url;

/// How often a request is tried again, with pauses from .1 s that double up to 2 s.
const RETRIES: usize = 5;
/// Time after which a request is not tried again.
const PATIENCE: Duration = Duration::from_secs(60);

/// Codes of S3 that mean wrong or expired credentials, whatever the status of the answer.
const REFUSALS: [&str; 6] = [
    "AccessDenied",
    "ExpiredToken",
    "InvalidAccessKeyId",
    "InvalidToken",
    "RequestTimeTooSkewed",
    "SignatureDoesNotMatch",
];

/// Stands for the host of an emulator of Google Cloud Storage, in Google's own tools as well.
const EMULATOR: &str = "STORAGE_EMULATOR_HOST";

/// Requests run here, whatever thread waits for them.
static RUNTIME: LazyLock<io::Result<Runtime>> = LazyLock::new(|| {
    Builder::new_multi_thread().worker_threads(2).thread_name("store").enable_all().build()
});

/// Clients, by the URL of their bucket.
static CLIENTS: LazyLock<Mutex<HashMap<String, Arc<dyn ObjectStore>>>> =
    LazyLock::new(Mutex::default);

/// A place in a bucket.
#[derive(Clone)]
pub(crate) struct Location {
    pub(crate) store: Arc<dyn ObjectStore>,
    pub(crate) key: Key,
}

impl Location {
    /// What a URL names. The credentials are those of the usual variables of the environment.
    pub(crate) fn of(path: &Path) -> io::Result<Self> {
        let invalid = |found: String| {
            let message = format!("found {found}, expected a URL such as s3://bucket/key");
            io::Error::new(io::ErrorKind::InvalidInput, message)
        };
        let text = path.to_str().unwrap_or_default();
        let (scheme, rest) = text.split_once("://").unwrap_or_default();
        let (bucket, key) = rest.split_once('/').unwrap_or((rest, ""));
        let key =
            Key::parse(key.trim_end_matches('/')).map_err(|error| invalid(error.to_string()))?;
        let bucket = format!("{scheme}://{bucket}");
        Url::parse(&bucket).map_err(|error| invalid(error.to_string()))?;
        let mut clients = CLIENTS.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(store) = clients.get(&bucket) {
            return Ok(Self { store: store.clone(), key });
        }
        let store = connect(scheme, &bucket).map_err(|error| invalid(error.to_string()))?;
        clients.insert(bucket, store.clone());
        Ok(Self { store, key })
    }
}

fn connect(scheme: &str, bucket: &str) -> object_store::Result<Arc<dyn ObjectStore>> {
    // The only provider of cryptography that is compiled in; an error if another part of the program has chosen it before.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let backoff = BackoffConfig {
        init_backoff: Duration::from_millis(100),
        max_backoff: Duration::from_secs(2),
        base: 2.0,
    };
    let retry = RetryConfig { backoff, max_retries: RETRIES, retry_timeout: PATIENCE };
    if scheme == "s3" {
        let builder = AmazonS3Builder::from_env().with_url(bucket).with_retry(retry);
        return Ok(Arc::new(builder.build()?));
    }
    let mut builder = GoogleCloudStorageBuilder::from_env().with_url(bucket).with_retry(retry);
    #[expect(clippy::disallowed_methods, reason = "object_store itself reads the other variables")]
    if let Ok(host) = std::env::var(EMULATOR) {
        let url = if host.contains("://") { host } else { format!("http://{host}") };
        let client = object_store::ClientOptions::new().with_allow_http(true);
        builder = builder
            .with_config(GoogleConfigKey::BaseUrl, url)
            // Without a signature, object_store 0.14.2 would look for credentials all the same when it writes.
            .with_credentials(Arc::new(StaticCredentialProvider::new(GcpCredential {
                bearer: String::new(),
            })))
            .with_client_options(client);
    }
    Ok(Arc::new(builder.build()?))
}

/// Begins a request.
pub(crate) fn begin<T: Send + 'static>(
    request: impl Future<Output = object_store::Result<T>> + Send + 'static,
) -> mpsc::Receiver<io::Result<T>> {
    let (done, outcome) = mpsc::channel();
    match &*RUNTIME {
        Ok(runtime) => drop(runtime.spawn(async move {
            // The receiver is gone when nobody waits any more.
            let _ = done.send(request.await.map_err(|error| explained(&error)));
        })),
        Err(error) => drop(done.send(Err(io::Error::new(error.kind(), error.to_string())))),
    }
    outcome
}

/// Waits for a request.
pub(crate) fn wait<T: Send + 'static>(
    request: impl Future<Output = object_store::Result<T>> + Send + 'static,
) -> io::Result<T> {
    begin(request).recv().map_err(|_| io::Error::other("the request has ended"))?
}

/// An error in a sentence, without what the store repeats of the request.
fn explained(error: &Error) -> io::Error {
    let reason = reason(error);
    let (kind, message) = match error {
        Error::NotFound { .. } => (io::ErrorKind::NotFound, "does not exist in the store".into()),
        Error::AlreadyExists { .. } => {
            (io::ErrorKind::AlreadyExists, "was written to the store by another process".into())
        }
        Error::Precondition { .. } => (
            io::ErrorKind::Other,
            "was replaced in the store while it was read, expected the same object".into(),
        ),
        Error::PermissionDenied { .. } | Error::Unauthenticated { .. } => {
            (io::ErrorKind::PermissionDenied, refused(&reason))
        }
        _ if REFUSALS.iter().any(|code| reason.starts_with(code)) => {
            (io::ErrorKind::PermissionDenied, refused(&reason))
        }
        _ => (io::ErrorKind::Other, format!("the request to the store failed: {reason}")),
    };
    io::Error::new(kind, message)
}

fn refused(reason: &str) -> String {
    format!("the store refused access ({reason}), expected valid credentials in the environment")
}

/// Code and message of the store's answer (XML, as S3 and Google Cloud Storage have it), or the innermost cause.
fn reason(error: &Error) -> String {
    let text = error.to_string();
    let element = |name: &str| {
        let (_, rest) = text.split_once(&format!("<{name}>"))?;
        Some(rest.split_once(&format!("</{name}>"))?.0)
    };
    if let Some(code) = element("Code") {
        return match element("Message") {
            Some(message) => format!("{code}: {}", message.trim_end_matches('.')),
            None => code.to_owned(),
        };
    }
    let mut cause = error.source();
    while let Some(inner) = cause.and_then(|cause| cause.source()) {
        cause = Some(inner);
    }
    let text = cause.map_or(text, ToString::to_string);
    text.trim_end_matches([':', ' ']).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_of_a_store_becomes_a_sentence_without_the_request() {
        let body = "Server returned non-2xx status code: 400 Bad Request: <Error><Code>ExpiredToken</Code><Message>The provided \
                    token has expired.</Message><Token-0>s3cr3t</Token-0></Error>";
        let error = Error::Generic { store: "S3", source: body.into() };
        let explained = explained(&error);
        assert_eq!(explained.kind(), io::ErrorKind::PermissionDenied);
        assert_eq!(
            explained.to_string(),
            "the store refused access (ExpiredToken: The provided token has expired), expected valid credentials in the environment"
        );
    }

    #[test]
    fn a_url_without_a_bucket_or_with_an_empty_segment_is_rejected() {
        for url in ["s3:///key", "s3://bucket/a//b", "gs://"] {
            let Err(error) = Location::of(Path::new(url)) else { panic!("{url}") };
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{url}: {error}");
        }
    }
}
