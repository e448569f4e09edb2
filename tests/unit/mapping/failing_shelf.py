"""A shelf in memory that can fail as a disk does."""


class FailingShelf:
    """A shelf that takes `room` bytes, then refuses, and from get number `breaks` on cannot read."""

    def __init__(self, room=10**9, breaks=10**9):
        self.room, self.breaks, self.kept, self.gets = room, breaks, {}, 0

    def put(self, data):
        if len(data) > self.room:
            raise OSError(28, "No space left on device")
        self.room -= len(data)
        self.kept[len(self.kept)] = data
        return len(self.kept) - 1

    def get(self, number):
        self.gets += 1
        if self.gets > self.breaks:
            raise OSError(5, "Input/output error")
        return self.kept[number]

    def drop(self, number):
        self.kept[number] = None
