//! ROS 2 bags in SQLite (`.db3`), read by the library SQLite itself.
//!
//! The tables: `topics` and `messages`; from version 4 on also `message_definitions`
//! (github.com/ros2/rosbag2, rosbag2_storage_sqlite3). Older bags hold no definitions: those of ROS's own messages are
//! known here, others must be put in.

/// What such a bag is called.
pub(super) const FORM: &str = "ROS 2 bag (SQLite)";

#[cfg(not(feature = "rosbag2"))]
pub(super) fn read(
    _: &mut super::bag::Bag,
    path: &std::path::Path,
    _: &mut dyn FnMut(u64),
) -> Result<u64, super::ForeignError> {
    Err(super::ForeignError::NoSqlite { path: path.into() })
}

#[cfg(feature = "rosbag2")]
pub(super) use sqlite::read;

#[cfg(feature = "rosbag2")]
mod sqlite {
    use std::collections::BTreeMap;
    use std::io::Read;
    use std::path::Path;

    use rusqlite::{Connection, OpenFlags};

    use super::super::ForeignError;
    use super::super::bag::{Bag, Decoder};
    use super::super::definitions::known;
    use super::super::ros::Definition;

    /// How a message that was compressed by itself begins.
    const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
    /// A message of more bytes is not unpacked.
    const LONGEST: u64 = 1 << 30;

    /// Reads a file of the bag; gives its size.
    pub(in super::super) fn read(
        bag: &mut Bag,
        path: &Path,
        progress: &mut dyn FnMut(u64),
    ) -> Result<u64, ForeignError> {
        let size = path.metadata().map_err(|source| ForeignError::Io { path: path.into(), source })?.len();
        let refuse = |error: rusqlite::Error| ForeignError::Database { path: path.into(), source: error };
        let database = open(path).map_err(refuse)?;
        bag.form = super::FORM.into();
        let definitions = definitions(&database).map_err(refuse)?;
        let topics = topics(bag, &database, &definitions).map_err(refuse)?;
        let rows: u64 = database
            .query_row("SELECT max(rowid) FROM messages", [], |row| row.get::<_, Option<i64>>(0))
            .map_err(refuse)?
            .map_or(0, i64::unsigned_abs);
        // In the order in which they were written, which is nearly that of time; what is out of order is sorted later.
        let mut query = database
            .prepare("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid")
            .map_err(refuse)?;
        let mut messages = query.query([]).map_err(refuse)?;
        let mut count = 0_u64;
        loop {
            let row = match messages.next() {
                Ok(Some(row)) => row,
                Ok(None) => break,
                // As of a disk that was full, or a machine that lost its power.
                Err(error) if count > 0 => {
                    let path = path.display();
                    bag.notes
                        .push(format!("{path} is damaged after {count} messages ({error}); these are read"));
                    break;
                }
                Err(error) => return Err(refuse(error)),
            };
            count += 1;
            if count.is_multiple_of(4096) {
                progress((size as f64 * count as f64 / rows.max(count) as f64) as u64);
            }
            let topic: i64 = row.get(0).map_err(refuse)?;
            let Some((topic, Some(decoder))) = topics.get(&topic) else { continue };
            let logged: i64 = row.get(1).map_err(refuse)?;
            let data = row.get_ref(2).map_err(refuse)?;
            let data = data.as_blob().map_err(|error| refuse(error.into()))?;
            let logged = u64::try_from(logged).unwrap_or_default();
            if data.starts_with(&ZSTD) {
                // One that cannot be unpacked is one that cannot be decoded.
                bag.put(topic, decoder, logged, &unpacked(data).unwrap_or_default());
            } else {
                bag.put(topic, decoder, logged, data);
            }
        }
        progress(size);
        Ok(size)
    }

    /// Opens a database that is only read. SQLite would make files beside one whose journal is written ahead, which a folder that
    /// may not be written to refuses; so it is told that nobody writes, unless such a journal is there and has to be read.
    fn open(path: &Path) -> rusqlite::Result<Connection> {
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut journal = path.as_os_str().to_owned();
        journal.push("-wal");
        let journal = Path::new(&journal).metadata().is_ok_and(|file| file.len() > 0);
        let Some(text) = path.to_str().filter(|_| !journal) else {
            return Connection::open_with_flags(path, flags);
        };
        let escaped = text.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
        let flags = flags | OpenFlags::SQLITE_OPEN_URI;
        Connection::open_with_flags(format!("file:{escaped}?immutable=1"), flags)
    }

    /// The definitions that the bag holds, with the language of each, by type.
    fn definitions(database: &Connection) -> rusqlite::Result<BTreeMap<String, (String, String)>> {
        let mut found = BTreeMap::new();
        if !database.table_exists(None, "message_definitions")? {
            return Ok(found);
        }
        let mut query = database
            .prepare("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")?;
        let mut rows = query.query([])?;
        while let Some(row) = rows.next()? {
            found.insert(row.get(0)?, (row.get(1)?, row.get(2)?));
        }
        Ok(found)
    }

    /// The topics, by number: their names, and how their messages are decoded.
    fn topics(
        bag: &mut Bag,
        database: &Connection,
        definitions: &BTreeMap<String, (String, String)>,
    ) -> rusqlite::Result<BTreeMap<i64, (String, Option<Decoder>)>> {
        let mut found = BTreeMap::new();
        let mut query = database.prepare("SELECT id, name, type, serialization_format FROM topics")?;
        let mut rows = query.query([])?;
        while let Some(row) = rows.next()? {
            let (name, kind): (String, String) = (row.get(1)?, row.get(2)?);
            let format: String = row.get(3)?;
            let decoder = match format.as_str() {
                "cdr" => decoder(&kind, definitions.get(&kind)),
                other => Err(format!("messages in `{other}` are not read")),
            };
            let decoder = bag.declare(&name, kind, decoder);
            found.insert(row.get(0)?, (name, decoder));
        }
        Ok(found)
    }

    /// By the bag's own definition, or else by what is known of the type.
    fn decoder(kind: &str, own: Option<&(String, String)>) -> Result<Decoder, String> {
        if let Some((language, text)) = own.filter(|(_, text)| !text.trim().is_empty())
            && language == "ros2msg"
        {
            return Definition::parse(kind, text).map(Decoder::Ros);
        }
        let text = known(kind).ok_or_else(|| {
            "the bag holds no definition of this type; put them in with `rosbags-convert --src BAG --dst BAG_mcap \
             --dst-storage mcap` (`pip install rosbags`) where the package of the type is known"
                .to_owned()
        })?;
        Definition::parse(kind, &text).map(Decoder::Ros)
    }

    fn unpacked(data: &[u8]) -> std::io::Result<Vec<u8>> {
        let mut message = Vec::new();
        zstd::Decoder::with_buffer(data)?.take(LONGEST).read_to_end(&mut message)?;
        Ok(message)
    }
}
