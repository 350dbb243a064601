"""Reading and writing of files, whatever they contain: bounded reads, durable writes, paths, free memory."""
