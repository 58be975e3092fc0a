//! Acknowledgements of writes, as the image carries them.

use ipc_types::payload::{Image, MAX_ACKS};

/// Newest write taken of each writer. Beyond [`MAX_ACKS`] writers the one silent for longest is forgotten.
#[derive(Debug, Default)]
pub(super) struct Acks {
    touched: [u64; MAX_ACKS],
    clock: u64,
}

impl Acks {
    /// Notes a write that was taken.
    pub(super) fn note(&mut self, image: &mut Image, writer: u32, generation: u32, seq: u64, result: u32) {
        self.clock += 1;
        let place = (0..MAX_ACKS)
            .find(|&i| image.ack_writer[i] == writer)
            .or_else(|| (0..MAX_ACKS).find(|&i| image.ack_writer[i] == 0))
            .or_else(|| (0..MAX_ACKS).min_by_key(|&i| self.touched[i]))
            .unwrap_or(0);
        image.ack_writer[place] = writer;
        image.ack_generation[place] = generation;
        image.ack_seq[place] = seq;
        image.ack_result[place] = result;
        self.touched[place] = self.clock;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::payload::acks;

    #[test]
    fn a_writer_keeps_its_entry_and_the_oldest_makes_room() {
        let (mut table, mut image) = (Acks::default(), Image::default());
        for writer in 1..=MAX_ACKS as u32 {
            table.note(&mut image, writer, 1, 10, 0);
        }
        table.note(&mut image, 1, 2, 3, 4);
        assert_eq!(acks(&image).count(), MAX_ACKS);
        let first = acks(&image).next().unwrap();
        assert_eq!((first.writer, first.generation, first.seq, first.result), (1, 2, 3, 4));
        table.note(&mut image, 99, 1, 1, 0);
        let writers: Vec<u32> = acks(&image).map(|a| a.writer).collect();
        assert!(writers.contains(&99) && writers.contains(&1) && !writers.contains(&2));
    }
}
