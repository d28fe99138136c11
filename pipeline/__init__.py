"""What is computed: data, algorithms, environments, stages, report. It opens no socket and starts no process."""
