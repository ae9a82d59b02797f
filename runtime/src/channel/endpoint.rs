//! A process's access to a run's channels, which are services of iceoryx2.

use std::fmt::Debug;
use std::path::PathBuf;

use iceoryx2::prelude::*;
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::publisher::Publisher;
use super::subscriber::Subscriber;
use super::{ChannelError, Ipc, LOANED, Listener, Space, Topic, Waker, failed};

/// Attribute of a service under which the layout's hash stands.
const LAYOUT: &str = "parallax.layout";

/// One process's, or one thread's, access to a run's channels.
#[derive(Debug)]
pub struct Endpoint {
    node: iceoryx2::node::Node<Ipc>,
    /// The run's directory, where the wake-ups lie.
    run: PathBuf,
}

/// A channel that exists: opened or created.
#[derive(Debug)]
pub struct Service {
    factory: PortFactory<Ipc, [u64], ()>,
    topic: Topic,
}

fn service_name(topic: &str) -> Result<ServiceName, ChannelError> {
    ServiceName::new(topic).map_err(|e| failed(topic, "use the name")(&e))
}

impl Endpoint {
    /// Opens this process's access to a space.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`] when iceoryx2 cannot work in the space.
    pub fn new(space: &Space) -> Result<Self, ChannelError> {
        // Every failure comes back as an error value and is reported once, by whoever handles it.
        set_log_level(LogLevel::Fatal);
        let config = space.config()?;
        let node = NodeBuilder::new()
            .config(&config)
            // The launcher decides what a signal means, not the transport.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| failed("(all)", "open shared memory")(&e))?;
        Ok(Self { node, run: space.path().into() })
    }

    /// Creates a channel. It exists while somebody holds the service or a port of it.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`] when it exists already, or cannot be made.
    pub fn create(&self, topic: &Topic) -> Result<Service, ChannelError> {
        self.create_for(topic, 1)
    }

    /// As [`create`](Self::create), for so many publishers: one, and the link to other machines where the channel crosses.
    pub(crate) fn create_for(&self, topic: &Topic, publishers: usize) -> Result<Service, ChannelError> {
        let fail = failed(&topic.name, "create the channel");
        let (key, value) = attribute(topic)?;
        let attributes = AttributeSpecifier::new().define(&key, &value).map_err(|e| fail(&e))?;
        let factory = self
            .node
            .service_builder(&service_name(&topic.name)?)
            .publish_subscribe::<[u64]>()
            .max_publishers(publishers)
            .max_subscribers(topic.subscribers.max(1))
            .max_nodes(topic.subscribers + 1 + publishers)
            .subscriber_max_buffer_size(topic.buffer.max(1))
            .subscriber_max_borrowed_samples(topic.borrowed())
            .history_size(0)
            // The newest message is worth more than the oldest: a receiver that falls behind loses the oldest,
            // and counts the gap in the sequence numbers.
            .enable_safe_overflow(true)
            .create_with_attributes(&attributes)
            .map_err(|e| fail(&e))?;
        Ok(Service { factory, topic: topic.clone() })
    }

    /// Opens a channel that another endpoint created.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Layout`] when it was created with another layout, else [`ChannelError::Transport`].
    pub fn open(&self, topic: &Topic) -> Result<Service, ChannelError> {
        let fail = failed(&topic.name, "open the channel");
        let (key, value) = attribute(topic)?;
        let attributes = AttributeVerifier::new().require(&key, &value).map_err(|e| fail(&e))?;
        let opened = self
            .node
            .service_builder(&service_name(&topic.name)?)
            .publish_subscribe::<[u64]>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(topic.buffer.max(1))
            .open_with_attributes(&attributes);
        match opened {
            Ok(factory) => Ok(Service { factory, topic: topic.clone() }),
            Err(PublishSubscribeOpenError::IncompatibleAttributes) => {
                Err(ChannelError::Layout { topic: topic.name.clone(), expected: topic.layout })
            }
            Err(e) => Err(fail(&e)),
        }
    }

    /// Removes what participants left behind that have died. Until then their ports count as there: nobody can take their
    /// place. Gives the number of those that were removed.
    pub fn remove_dead(&self) -> u64 {
        self.node.blocking_cleanup_dead_nodes(std::time::Duration::from_millis(200)).cleanups
    }

    /// The listener `name`: what every waker of that name wakes. A name has one listener at a time.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`] when it cannot be put into the run's directory.
    pub fn listener(&self, name: &str) -> Result<Listener, ChannelError> {
        Listener::create(&self.run, name)
    }

    /// A waker of the listener `name`, which must exist.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`] when there is no such listener.
    pub fn waker(&self, name: &str) -> Result<Waker, ChannelError> {
        Waker::open(&self.run, name)
    }
}

fn attribute(topic: &Topic) -> Result<(AttributeKey, AttributeValue), ChannelError> {
    let fail = failed(&topic.name, "describe the layout");
    Ok((
        AttributeKey::new(LAYOUT.as_bytes()).map_err(|e| fail(&e))?,
        AttributeValue::new(format!("{:016x}/{}", topic.layout, topic.words).as_bytes())
            .map_err(|e| fail(&e))?,
    ))
}

impl Service {
    /// The sending end; a channel has one.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn publisher(self) -> Result<Publisher, ChannelError> {
        let port = self
            .factory
            .publisher_builder()
            .initial_max_slice_len(self.topic.words)
            .max_loaned_samples(LOANED)
            // "Retry" would poll with sleeps of up to 10 ms inside a step.
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| failed(&self.topic.name, "publish")(&e))?;
        Ok(Publisher::new(port, self.factory, self.topic))
    }

    /// A receiving end.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn subscriber(&self) -> Result<Subscriber, ChannelError> {
        let port = self
            .factory
            .subscriber_builder()
            .buffer_size(self.topic.buffer.max(1))
            .create()
            .map_err(|e| failed(&self.topic.name, "subscribe")(&e))?;
        Ok(Subscriber::new(port, self.topic.clone()))
    }
}
